"""Experiment 1.1 of the paper; see configs/exp/1.1.yaml."""

from corrmat.scripts import reproduce

if __name__ == "__main__":
    reproduce("1.1")
