"""An experiment: every arm trained, tested once on the frozen pairs, and written as a record."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import torch
from torch import Tensor

from corrmat.baselines import BASELINES, OPTIONAL, UNTRAINED, is_available
from corrmat.data.datamodule import PairDataset
from corrmat.errors import CorrmatError
from corrmat.files import ensure_writable
from corrmat.losses import CorrespondenceLoss
from corrmat.metrics import summary
from corrmat.module import OptimizerSettings, RegistrationModule
from corrmat.reporting.claims import verdicts
from corrmat.reporting.record import ArmResult, Record, Subset
from corrmat.reporting.snapshots import PairSnapshot, take_snapshot
from corrmat.reporting.tables import terminal_table
from corrmat.reporting.writer import pair_rows, write_record
from corrmat.revision import commit
from corrmat.training import loggers, runs
from corrmat.training.console import Board
from corrmat.training.fit import fresh_method, load_trained, score, seconds_to_train, train
from corrmat.training.hardware import is_first_process
from corrmat.training.preflight import Arm, prepare
from corrmat.training.recipe import Recipe
from corrmat.training.runs import TrainedArm

log = logging.getLogger("corrmat")
Tests = list[dict[str, Tensor]]
"""Per-pair values of a test, one set a rotation band."""


def run(
    recipe: Recipe,
    results: Path,
    runs_folder: Path,
    logger: loggers.Choice = "csv",
    *,
    fresh: bool = False,
) -> Record | None:
    """Train and test every arm, and write the record when all are done.

    Args:
        recipe: the experiment.
        results: folder of records; this one goes to <scale>/<data>/<id>.
        runs_folder: folder of checkpoints and logs, the same below it.
        logger: see `loggers.make_loggers`.
        fresh: start anew where a run was interrupted or an arm is trained already.

    Returns:
        The record; None in the further processes of a distributed run.
    """
    for folder in (results, runs_folder):
        ensure_writable(folder / recipe.place)
    with runs.only_process(runs_folder / recipe.place):  # to the end: the record is of these runs
        return _run(recipe, results, runs_folder, logger, fresh=fresh)


def _run(
    recipe: Recipe, results: Path, runs_folder: Path, logger: loggers.Choice, *, fresh: bool
) -> Record | None:
    run_at = commit()
    arms = [prepare(settings) for settings in recipe.arms.values()]
    digest = _check_test_pairs(recipe, arms)
    trained: dict[str, TrainedArm] = {}
    arm_results: dict[str, ArmResult] = {}
    baseline_results: dict[str, ArmResult] = {}
    rows: list[dict[str, object]] = []
    snapshots: list[PairSnapshot] = []
    if is_first_process():
        log.info(f"\n{recipe.id}  {recipe.title}  ({recipe.scale}, {recipe.data})")
        for arm in arms:
            if fresh or runs.find_trained(recipe, arm, runs_folder) is None:
                log.info(f"{arm.name}: {_time_to_train(arm)}")
    with Board() as board:
        for arm in arms:
            log.info(f"\n{recipe.id} {arm.name} ({recipe.scale}, {recipe.data})")
            trained[arm.name] = train_or_reuse(recipe, arm, runs_folder, logger, board, fresh=fresh)
            if not is_first_process():  # further processes only train
                continue
            method = load_trained(arm, trained[arm.name].checkpoint)
            tests, arm_results[arm.name] = evaluate(method, arm, recipe, trained[arm.name])
            rows += pair_rows(arm.name, tests)
            if arm.name == recipe.treatment:
                snapshots = _snapshots(method, arm, tests, recipe)
    if not is_first_process():
        return None
    treatment = next(arm for arm in arms if arm.name == recipe.treatment)
    for name in recipe.baselines:
        if not is_available(name):
            log.info(f"the baseline {name} is left out: pip install {' '.join(OPTIONAL[name])}")
            continue
        tests, baseline_results[name] = evaluate(_baseline(name, treatment), treatment, recipe)
        rows += pair_rows(name, tests)
    record = Record(
        id=recipe.id,
        title=recipe.title,
        scale=recipe.scale,
        data=recipe.data,
        family=recipe.family,
        baseline=recipe.baseline,
        treatment=recipe.treatment,
        controls=list(recipe.controls),
        seed=arms[0].settings.seed,
        commit=run_at,
        hardware=_merge_hardware([arm.hardware for arm in trained.values()]),
        versions={name: version(name) for name in ("corrmat", "torch", "lightning", "numpy")},
        test_pairs=digest,
        bands_deg=list(recipe.bands_deg),
        arms=arm_results,
        baselines=baseline_results,
        paper=recipe.paper,
    )
    write_record(results / recipe.place, record, _config(recipe), rows, snapshots)
    for arm in arms:
        runs.mark_recorded(runs_folder / recipe.place / arm.name)
    print(terminal_table(record), flush=True)
    log.info(verdicts(record, results))
    log.info(f"pictures and record: {results / recipe.place}/curves.png")
    loggers.log_record(
        logger, runs_folder / recipe.place, record, snapshots, results / recipe.place
    )
    return record


def train_or_reuse(
    recipe: Recipe,
    arm: Arm,
    runs_folder: Path,
    logger: loggers.Choice,
    board: Board | None = None,
    *,
    fresh: bool = False,
) -> TrainedArm:
    """Train an arm of an experiment, unless it is trained already."""
    folder = runs_folder / recipe.place / arm.name
    with runs.only_process(folder):
        trained = None if fresh else runs.find_trained(recipe, arm, runs_folder)
        if trained is not None:
            log.info(f"trained already: {trained.checkpoint.parent}")
            return trained
        return train(arm, folder, recipe.place.as_posix(), logger, board, fresh=fresh)


def _time_to_train(arm: Arm) -> str:
    """Say how long an arm trains on this machine, as far as a timed step tells."""
    seconds = seconds_to_train(arm)
    if seconds is None:
        return "trains on a GPU, or until it is stopped: no estimate"
    return f"about {max(seconds / 60, 0.1):.2g} min of training on this machine"


def _check_test_pairs(recipe: Recipe, arms: Sequence[Arm]) -> str:
    """Compute the digest of the test pairs, and warn if the recipe expects another.

    Raises:
        CorrmatError: the arms have different ones, so that nothing could be compared.
    """
    first = arms[0].datamodule
    for arm in arms[1:]:
        if arm.datamodule.test_settings != first.test_settings:
            raise CorrmatError(
                f"{arms[0].name} and {arm.name} would be tested on different pairs: their data may "
                "differ in what training alone uses (batch_size, train_shapes, stretch, ...)"
            )
    for share in recipe.sweep_outliers:
        replace(first.pairs, outliers=share)  # which checks it
    digest = first.test_pairs_digest(recipe.test_changes)
    if recipe.test_pairs in (None, digest):
        return digest
    message = "the test pairs made here (%s) are not the recipe's (%s): numbers compare with other "
    message += "records in the mean only"
    log.warning(message, digest, recipe.test_pairs)
    return digest


def evaluate(
    module: RegistrationModule, arm: Arm, recipe: Recipe, trained: TrainedArm | None = None
) -> tuple[Tests, ArmResult]:
    """Test a module on everything that a recipe asks for.

    Returns:
        Per-pair values, one set a rotation band; and the result for the record.
    """
    tests = score(module, arm, recipe.test_changes)
    shares = recipe.sweep_outliers
    sweep = score(module, arm, [{"outliers": share} for share in shares]) if shares else []
    together = {key: torch.cat([values[key] for values in tests]) for key in tests[0]}
    edges = recipe.bands_deg
    band_results = [
        Subset(summary(values), band_deg=(low, high))
        for low, high, values in zip(edges, edges[1:], tests, strict=False)
    ]
    sweep_results = [
        Subset(summary(values), outliers=share) for share, values in zip(shares, sweep, strict=True)
    ]
    result = ArmResult(summary(together), band_results, sweep_results)
    if trained is not None:
        result = ArmResult(
            result.metrics, result.bands, result.sweep, trained.pairs_seen,
            round(trained.train_seconds, 1), trained.commit, trained.curve,
        )  # fmt: skip
    return tests, result


@torch.no_grad()
def _snapshots(
    module: RegistrationModule, arm: Arm, tests: Tests, recipe: Recipe
) -> list[PairSnapshot]:
    """Take snapshots of the easiest, median and hardest pair of a METHOD_corr.

    Pairs without a finite prediction are left out: there is nothing to draw.
    """
    if not isinstance(module, CorrespondenceLoss):
        return []
    module.cpu().eval()
    per_band = len(tests[0]["shape"])
    errors = torch.cat([values["rotation_error_deg"] for values in tests])
    order = errors.argsort()[: int(errors.isfinite().sum())].tolist()  # NaN comes last
    if not order:
        return []
    snapshots = []
    for rank, position in (("easiest", 0), ("median", len(order) // 2), ("hardest", -1)):
        band, index = divmod(order[position], per_band)
        dataset = arm.datamodule.test_dataloader(**recipe.test_changes[band]).dataset
        assert isinstance(dataset, PairDataset)
        pair = dataset[(0, index)]
        prediction = module(pair.source, pair.target)
        error = float(errors[order[position]])
        snapshots.append(take_snapshot(arm.name, rank, error, pair, prediction))
    return snapshots


def _baseline(name: str, arm: Arm) -> RegistrationModule:
    """Build a baseline; "untrained" is the arm's own network before training."""
    if name == UNTRAINED:
        return fresh_method(arm.settings)
    return RegistrationModule(BASELINES[name](), OptimizerSettings())


def _merge_hardware(arms: Sequence[Mapping[str, object]]) -> dict[str, object]:
    """Describe what all arms were trained on; "a / b" where they differ."""
    merged: dict[str, object] = {}
    for key in arms[0]:
        values = list(dict.fromkeys(arm.get(key) for arm in arms))
        merged[key] = values[0] if len(values) == 1 else " / ".join(map(str, values))
    return merged


def _config(recipe: Recipe) -> dict[str, object]:
    """Return every setting of every arm, for config.yaml; the data's folder stays private."""
    arms = {name: settings.as_plain() for name, settings in recipe.arms.items()}
    for settings in arms.values():
        data = settings["data"]
        assert isinstance(data, dict)
        data.pop("root")
    return {"id": recipe.id, "scale": recipe.scale, "arms": arms}
