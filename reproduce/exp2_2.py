"""Experiment 2.2 of the paper; see configs/exp/2.2.yaml."""

from corrmat.scripts import reproduce

if __name__ == "__main__":
    reproduce("2.2")
