"""Many trainings at once: every arm of every experiment a task of a Ray cluster."""

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from corrmat import recipe
from corrmat.callbacks import say
from corrmat.cli import main, parser
from corrmat.errors import CorrmatError

RETRIES = 3  # of an arm whose worker is lost; it goes on from its last checkpoint


def train(configs: Sequence[Path], words: Sequence[str]) -> None:
    """Train all arms, as many at once as the cluster has room for.

    A task is `corrmat fit` of one arm. `corrmat run` then finds them trained, and writes the same
    records as without a cluster. All machines must see one folder of runs.

    Args:
        configs: experiments; those that test the networks of another one have nothing to train.
        words: options of `corrmat run`, for all arms.

    Raises:
        CorrmatError: Ray is missing, or an arm fails.
    """
    os.environ.setdefault("RAY_DEDUP_LOGS", "0")  # lines of two arms may be alike
    try:
        import ray  # pyright: ignore[reportMissingImports] (an extra)
        from ray.exceptions import RayError  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise CorrmatError("LAUNCHER=ray needs Ray: pip install ray") from error
    only_run = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    only_run.add_argument("--results")
    _, words = only_run.parse_known_args(words)
    known, options = parser().parse_known_args(["fit", *words])
    found = [recipe.load(config, known.scale, options) for config in configs]
    arms = [
        (config, arm)
        for config, experiment in zip(configs, found, strict=True)
        for arm in experiment.settings
        if not experiment.networks_of
    ]
    # RAY_ADDRESS names a cluster; without it this machine is one.
    ray.init(address=os.environ.get("RAY_ADDRESS"), ignore_reinit_error=True)
    gpus = 1 if ray.cluster_resources().get("GPU") else 0
    task = ray.remote(num_cpus=1, num_gpus=gpus, max_retries=RETRIES)(fit)
    common = [*words, "--runs", str(known.runs.absolute())]
    left = {}
    for config, arm in arms:
        name = f"{config.stem} {arm}"  # stands before every line that the arm prints
        own = ["fit", "--config", str(config.absolute()), "--arm", arm]
        left[task.options(name=name).remote([*own, *common])] = name
    while left:
        done, _ = ray.wait(list(left))
        name = left.pop(done[0])
        try:
            ray.get(done[0])
        except RayError as error:
            raise CorrmatError(f"{name}: {str(error).splitlines()[-1]}") from error
        say(f"{name}: trained; {len(left)} left")


def fit(words: list[str]) -> None:
    """One arm, in the process of a Ray worker.

    Raises:
        CorrmatError: it cannot be trained; the worker's log says why.
    """
    code = main(words)
    if code:
        raise CorrmatError(f"corrmat {' '.join(words)} ended with code {code}")
