"""Make a data set's shapes on all cores, once, into shards that survive an interruption."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar, cast

import joblib
import numpy as np
from filelock import Timeout
from joblib.externals.loky import get_reusable_executor

from corrmat.data.clouds import finish_shards, log, missing_shards, write_shard
from corrmat.files import folder_lock
from corrmat.progress import track

SHARD = 250  # shapes of a shard

Task = TypeVar("Task")
Shape = tuple[np.ndarray, int]
"""Rows (P, 6) and label of a shape."""


def build_shards(
    folder: Path,
    names: Sequence[str],
    tasks: Sequence[Task],
    make: Callable[[Task], Shape | str],
    title: str,
) -> None:
    """Make every shape and write complete shards; a repeated call continues with the next shard.

    One process does so at a time; another one that wants the same shapes waits for them.

    The work runs in joblib's worker processes. Unlike multiprocessing's, they do not import the
    caller's main module, so a plain script, `python -c` and a notebook can call this.

    Args:
        folder: of the shards.
        names: of the categories.
        tasks: one a shape.
        make: returns a task's shape, or the reason why there is none; a function of a module.
        title: of the progress bar.
    """
    chunks = [tasks[start : start + SHARD] for start in range(0, len(tasks), SHARD)]
    with _in_turn(folder, title):
        missing = missing_shards(folder, len(chunks))
        pending = [task for number in missing for task in chunks[number]]
        shapes = joblib.Parallel(n_jobs=-1, return_as="generator")(
            joblib.delayed(make)(task) for task in pending
        )
        assert isinstance(shapes, Iterator)
        progress = cast(
            Iterator[Shape | str], iter(track(shapes, title, len(pending), transient=False))
        )
        for number in missing:
            results = [next(progress) for _ in chunks[number]]
            good = [result for result in results if not isinstance(result, str)]
            rows = np.stack([rows for rows, _ in good]) if good else np.empty((0, 0, 6), np.float32)
            labels = np.array([label for _, label in good], np.int64)
            write_shard(folder, number, rows, labels, [r for r in results if isinstance(r, str)])
        for _ in progress:  # lets the bar reach its end
            pass
        if pending:  # joblib keeps idle workers for minutes, and their memory
            get_reusable_executor().shutdown(wait=True)
        finish_shards(folder, names, len(chunks))


@contextlib.contextmanager
def _in_turn(folder: Path, title: str) -> Iterator[None]:
    """Wait until no other process makes these shapes, and keep others waiting meanwhile."""
    lock = folder_lock(folder)
    try:
        held = lock.acquire(timeout=0)
    except Timeout:
        log.info(f"{title}: another process makes them; waiting")
        held = lock.acquire()
    with held:
        yield
