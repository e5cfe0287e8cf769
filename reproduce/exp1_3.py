"""Experiment 1.3 of the paper; see configs/exp/1.3.yaml."""

from corrmat.scripts import reproduce

if __name__ == "__main__":
    reproduce("1.3")
