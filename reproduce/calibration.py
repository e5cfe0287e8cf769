"""The confidence of the shipped weights, fitted anew: after a change of how they are used."""

from corrmat.registration.shipping import recalibrate

if __name__ == "__main__":
    recalibrate()
