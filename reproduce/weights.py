"""The weights that `corrmat register` ships: trained, calibrated, put into the package.

Only what was trained at laptop scale on the embedded shapes is shipped; `make weights SCALE=smoke`
checks that everything runs.
"""

from corrmat.scripts import train_weights

if __name__ == "__main__":
    train_weights()
