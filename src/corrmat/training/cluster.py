"""Many trainings at once: every arm of every experiment is a task of a Ray cluster."""

import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from corrmat.errors import CorrmatError
from corrmat.training import loggers, recipe
from corrmat.training.console import print_messages
from corrmat.training.experiment import train_or_reuse
from corrmat.training.fit import silence_libraries
from corrmat.training.hardware import flush_denormals
from corrmat.training.preflight import prepare

log = logging.getLogger("corrmat")
RETRIES = 3  # of an arm whose worker is lost; without `fresh` it continues from its checkpoint


def train_all(
    configs: Sequence[Path],
    scale: str,
    overrides: Mapping[str, object],
    runs_folder: Path,
    logger: loggers.Choice = "csv",
    *,
    fresh: bool = False,
) -> None:
    """Train all arms, as many at once as the cluster has room for.

    `corrmat run` then finds them trained, and writes the same records as without a cluster. All
    machines must see one folder of runs. RAY_ADDRESS names a cluster; without it this machine is
    one.

    Args:
        configs: experiments; those that test the networks of another one have nothing to train.
        scale: of all experiments.
        overrides: of all arms, see `recipe.load`.
        runs_folder: folder of checkpoints and logs.
        logger: see `loggers.make_loggers`.
        fresh: start anew.

    Raises:
        CorrmatError: Ray is missing, or an arm fails.
    """
    os.environ.setdefault("RAY_DEDUP_LOGS", "0")  # two arms may print equal lines
    try:
        import ray  # pyright: ignore[reportMissingImports] (an extra)
        from ray.exceptions import RayError  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise CorrmatError("LAUNCHER=ray needs Ray: pip install ray") from error
    recipes = [recipe.load(config, scale, overrides) for config in configs]
    arms = [
        (config, arm)
        for config, experiment in zip(configs, recipes, strict=True)
        for arm in experiment.arms
        if not experiment.networks_of
    ]
    ray.init(address=os.environ.get("RAY_ADDRESS"), ignore_reinit_error=True)
    gpus = 1 if ray.cluster_resources().get("GPU") else 0
    task = ray.remote(num_cpus=1, num_gpus=gpus, max_retries=RETRIES)(train_one)
    common = scale, dict(overrides), runs_folder.absolute(), logger, fresh
    pending = {}
    for config, arm in arms:
        name = f"{config.stem} {arm}"  # stands before every line that the arm prints
        pending[task.options(name=name).remote(config.absolute(), arm, *common)] = name
    while pending:
        done, _ = ray.wait(list(pending))
        name = pending.pop(done[0])
        try:
            ray.get(done[0])
        except RayError as error:
            raise CorrmatError(f"{name}: {str(error).splitlines()[-1]}") from error
        log.info(f"{name}: trained; {len(pending)} left")


def train_one(
    config: Path,
    arm: str,
    scale: str,
    overrides: Mapping[str, object],
    runs_folder: Path,
    logger: loggers.Choice,
    fresh: bool,
) -> None:
    """Train one arm in the process of a Ray worker."""
    print_messages(0)
    silence_libraries()
    flush_denormals()
    experiment = recipe.load(config, scale, overrides, [arm])
    train_or_reuse(experiment, prepare(experiment.arms[arm]), runs_folder, logger, fresh=fresh)
