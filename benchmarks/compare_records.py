"""Compare the numbers of two folders of records, bit for bit: did a change of code move any?

    python benchmarks/compare_records.py before/results after/results

Prints every metric of an arm or baseline that differs, and exits with 1 if one does. Times,
commits and digests of test pairs are not compared.
"""

import json
import sys
from collections.abc import Iterator
from pathlib import Path

NOT_COMPARED = {"train_seconds", "trained_at"}


def differences(before: object, after: object, place: str) -> Iterator[str]:
    """Yield a line for every value that differs in nested results."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in (before.keys() | after.keys()) - NOT_COMPARED:
            yield from differences(before.get(key), after.get(key), f"{place} {key}")
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for index, both in enumerate(zip(before, after, strict=True)):
            yield from differences(*both, f"{place}[{index}]")
    elif before != after:
        yield f"{place}: {before} -> {after}"


def main(before: Path, after: Path) -> int:
    """Compare every metrics.json below two folders."""
    changed = 0
    paths = sorted(path.relative_to(before) for path in before.glob("*/*/*/metrics.json"))
    for path in paths:
        if not (after / path).is_file():
            print(f"{path.parent}: missing")
            changed += 1
            continue
        old, new = (json.loads((folder / path).read_text()) for folder in (before, after))
        lines = [
            line
            for group in ("arms", "baselines")
            for line in differences(old[group], new[group], group)
        ]
        print(f"{path.parent}: {f'{len(lines)} values differ' if lines else 'equal'}")
        for line in lines[:4]:
            print(f"    {line}")
        changed += bool(lines)
    print(f"{len(paths)} records, {changed} differ")
    return int(changed > 0)


if __name__ == "__main__":
    sys.exit(main(*map(Path, sys.argv[1:3])))
