"""The trained arms of recorded experiments, put into the package for `corrmat.load_model`."""

from corrmat.scripts import ship_arms

if __name__ == "__main__":
    ship_arms()
