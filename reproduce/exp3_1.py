"""Experiment 3.1 of the paper; see configs/exp/3.1.yaml."""

from corrmat.scripts import reproduce

if __name__ == "__main__":
    reproduce("3.1")
