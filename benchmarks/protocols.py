"""The tables of `corrmat register`: every model on every protocol, into results/register.

Networks of the experiments in the shipped one's place make networks.json.

make protocols ROOT=folder-of-modelnet40
"""

import argparse
import sys
from pathlib import Path

from corrmat.cli import main
from corrmat.registration.benchmark import PROTOCOLS, TABLE_POINTS

RESULTS = Path(__file__).resolve().parents[1] / "results" / "register"
MODELS = "corrmat,ransac,ransac17,fgr,kiss,icp"
NETWORKS = "corrmat,2.2/RPMNet_corr,outliers/DCP_corr"


def run(root: Path | None) -> None:
    """Evaluate and record each of them; the real data only where they are at hand."""
    compare(NETWORKS, "networks", [])
    for data in ("shapes", *(("modelnet40",) if root else ())):
        for protocol in filter(PROTOCOLS.__contains__, TABLE_POINTS):
            for points in TABLE_POINTS[protocol]:
                name = f"{protocol}-{data}-{points}"
                words = ["--protocol", protocol, "--data", data, "--points", str(points)]
                words += ["--root", str(root)] if data == "modelnet40" else []
                compare(MODELS, name, words)


def compare(models: str, name: str, words: list[str]) -> None:
    """Compare models and write the record of this name."""
    print(f"\n{name}")
    code = main(["compare", models, *words, "--record", str(RESULTS / f"{name}.json")])
    if code:
        sys.exit(code)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", type=Path, help="folder of modelnet40")
    run(parser.parse_args().root)
