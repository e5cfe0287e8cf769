"""Experiment 3.2 of the paper; see configs/exp/3.2.yaml."""

from corrmat.scripts import reproduce

if __name__ == "__main__":
    reproduce("3.2")
