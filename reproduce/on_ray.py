"""Train every arm of every experiment on a Ray cluster; `make all LAUNCHER=ray` then tests them."""

from corrmat.scripts import train_on_ray

if __name__ == "__main__":
    train_on_ray()
