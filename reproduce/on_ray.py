"""Train every arm of every experiment on a Ray cluster; `make all LAUNCHER=ray` then tests them."""

import sys
from pathlib import Path

from corrmat import console
from corrmat.cluster import train
from corrmat.errors import CorrmatError

CONFIGS = Path(__file__).resolve().parents[1] / "configs" / "exp"

if __name__ == "__main__":
    console.listen(0)
    try:
        train(sorted(CONFIGS.glob("*.yaml")), sys.argv[1:])
    except CorrmatError as error:
        sys.exit(f"corrmat: error: {error}")
