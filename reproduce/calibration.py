"""The confidence of the shipped weights, fitted anew: after a change of how they are used."""

from pathlib import Path

from corrmat.registration.shipping import recalibrate

if __name__ == "__main__":
    recalibrate(Path(__file__).resolve().parents[1] / "results")
