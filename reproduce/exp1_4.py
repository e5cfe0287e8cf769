"""Experiment 1.4 of the paper; see configs/exp/1.4.yaml."""

from corrmat.scripts import reproduce

if __name__ == "__main__":
    reproduce("1.4")
