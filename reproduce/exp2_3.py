"""Experiment 2.3 of the paper; see configs/exp/2.3.yaml."""

from corrmat.scripts import reproduce

if __name__ == "__main__":
    reproduce("2.3")
