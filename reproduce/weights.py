"""The weights that `corrmat register` ships: trained, calibrated, put into the package.

Only what was trained at laptop scale on the embedded shapes is shipped; `make weights SCALE=smoke`
sees whether everything runs.
"""

import sys
from pathlib import Path

from corrmat import recipe
from corrmat.cli import main, parser
from corrmat.shipping import ship

RECIPE = Path(__file__).resolve().parents[1] / "configs" / "weights.yaml"

if __name__ == "__main__":
    words = ["fit", "--config", str(RECIPE), *sys.argv[1:]]
    known, options = parser().parse_known_args(words)
    if known.scale == "paper":
        sys.exit("corrmat: error: the paper has no such network: SCALE=laptop or smoke")
    code = main(words)
    if code == 0 and not known.help:
        found = recipe.load(RECIPE, known.scale, options)
        if (found.scale, found.data) == ("laptop", "shapes"):
            ship(known.runs / "laptop" / "shapes" / found.id / "Invariant_corr" / "last.ckpt")
    sys.exit(code)
