"""Experiment B of the supplement; see configs/exp/outliers.yaml."""

from corrmat.scripts import reproduce

if __name__ == "__main__":
    reproduce("outliers")
