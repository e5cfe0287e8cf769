"""Figure 2 of the paper; see docs/robustness.md."""

import sys

from corrmat.cli import main

if __name__ == "__main__":
    sys.exit(main(["robustness", *sys.argv[1:]]))
