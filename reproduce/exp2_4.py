"""Experiment 2.4 of the paper; see configs/exp/2.4.yaml."""

from corrmat.scripts import reproduce

if __name__ == "__main__":
    reproduce("2.4")
