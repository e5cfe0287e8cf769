"""The confidence of the shipped weights, fitted anew: after a change of how they are used."""

from corrmat.registration.shipping import recalibrate
from corrmat.scripts import call

if __name__ == "__main__":
    call(recalibrate)
