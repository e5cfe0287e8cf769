"""The learning rate of every arm, chosen by the same sweep for one experiment of each family."""

from corrmat.scripts import sweep_rates

if __name__ == "__main__":
    sweep_rates(["1.2", "1.3", "2.2", "3.2", "outliers"])
