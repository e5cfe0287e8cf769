"""Experiment 2.1 of the paper; see configs/exp/2.1.yaml."""

from corrmat.scripts import reproduce

if __name__ == "__main__":
    reproduce("2.1")
