"""The weights that `corrmat register` ships: trained, calibrated, put into the package."""

import sys
from pathlib import Path

from corrmat.cli import main
from corrmat.shipping import ship

ROOT = Path(__file__).resolve().parents[1]
RECIPE = ROOT / "configs" / "weights.yaml"

if __name__ == "__main__":
    code = main(["fit", "--config", str(RECIPE), *sys.argv[1:]])
    scale = "smoke" if "smoke" in sys.argv else "laptop"
    if code == 0 and scale == "laptop":
        ship(Path("runs", scale, "shapes", "weights", "Invariant_corr", "last.ckpt"))
    sys.exit(code)
