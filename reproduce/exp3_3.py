"""Experiment 3.3 of the paper; see configs/exp/3.3.yaml."""

from corrmat.scripts import reproduce

if __name__ == "__main__":
    reproduce("3.3")
