"""The table of `corrmat register` in README.md: every model on every protocol, into results/.

make protocols ROOT=folder-of-modelnet40
"""

import argparse
import sys
from pathlib import Path

from corrmat.cli import main

RESULTS = Path(__file__).resolve().parents[1] / "results" / "register"
MODELS = "corrmat,ransac,fgr,icp"


def run(root: Path | None) -> None:
    """Evaluate and record each of them; the real data only where they are at hand."""
    for data in ("shapes", *(("modelnet40",) if root else ())):
        for protocol in ("real", "clean"):
            for points in (512, 1024):
                name = f"{protocol}-{data}-{points}"
                print(f"\n{name}")
                words = [MODELS, "--protocol", protocol, "--data", data, "--points", str(points)]
                words += ["--root", str(root)] if data == "modelnet40" else []
                path = RESULTS / f"{name}.json"
                code = main(["compare", *words, "--record", str(path)])
                if code:
                    sys.exit(code)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", type=Path, help="folder of modelnet40")
    run(parser.parse_args().root)
