"""Experiment 1.2 of the paper; see configs/exp/1.2.yaml."""

from corrmat.scripts import reproduce

if __name__ == "__main__":
    reproduce("1.2")
