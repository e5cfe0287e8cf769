"""A learning-rate sweep: every arm's rate is chosen by the same short trainings on validation."""

import logging
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path

from corrmat.errors import CorrmatError, DivergedError
from corrmat.files import ensure_writable, replace_json
from corrmat.reporting.record import defined
from corrmat.revision import commit
from corrmat.training import loggers
from corrmat.training.console import Board
from corrmat.training.experiment import train_or_reuse
from corrmat.training.fit import MONITOR
from corrmat.training.preflight import prepare
from corrmat.training.recipe import ArmSettings, Recipe

log = logging.getLogger("corrmat")
FACTORS = (1 / 3, 1.0, 3.0)  # of the recipe's rate
BUDGET = 1 / 20  # of an arm's training
FOLDER = "rates"  # below results/
_METRIC = MONITOR.removeprefix("val/")


@dataclass(frozen=True)
class RateResult:
    """How one learning rate did; keys of the record's JSON."""

    lr: float
    rotation_error_deg_mean: float | None  # on validation, at the end; None if it diverged
    loss: float | None
    pairs_seen: int | None
    commit: str | None  # of the code that trained it


def sweep(
    recipe: Recipe,
    results: Path,
    runs_folder: Path,
    logger: loggers.Choice = "csv",
    *,
    fresh: bool = False,
) -> dict[str, list[RateResult]]:
    """Train every arm for a twentieth of its budget at three rates, and write what came out.

    Arms with a steady rate are left out: theirs is the paper's own.

    Args:
        recipe: the experiment at the scale whose budget counts.
        results: folder of records; this one goes to rates/<scale>/<data>/<id>.json.
        runs_folder: folder of checkpoints and logs, resumed where one was interrupted.
        logger: see `loggers.make_loggers`.
        fresh: train anew what was trained before.

    Returns:
        By arm, the results in the order of the rates.

    Raises:
        CorrmatError: no arm has a rate to choose, or a budget in steps to take a twentieth of; or,
            when all is written, an arm diverged at every rate.
    """
    path = results / FOLDER / recipe.place.parent / f"{recipe.place.name}.json"
    ensure_writable(path.parent)
    arms = {n: s for n, s in recipe.arms.items() if s.optimizer.schedule == "onecycle"}
    if not arms:
        raise CorrmatError(f"{recipe.id} at {recipe.scale} scale has no arm with a rate to choose")
    endless = [name for name, settings in arms.items() if settings.trainer.max_steps < 1]
    if endless:
        raise CorrmatError(f"{endless[0]} has no --trainer.max_steps to take a twentieth of")
    today = commit()
    place = replace(recipe, id=f"{recipe.id}-rates", networks_of=None)
    swept: dict[str, list[RateResult]] = {}
    with Board() as board:
        for name, settings in arms.items():
            swept[name] = []
            for factor in FACTORS:
                arm = prepare(_short(settings, factor))
                log.info(f"\n{recipe.id} {arm.name}")
                lr = arm.settings.optimizer.lr
                try:
                    trained = train_or_reuse(place, arm, runs_folder, logger, board, fresh=fresh)
                except DivergedError as diverged:
                    log.info(str(diverged))
                    swept[name].append(RateResult(lr, None, None, None, today))
                    continue
                last = trained.curve[-1]
                error, loss = defined(last[_METRIC]), defined(last["loss"])
                swept[name].append(RateResult(lr, error, loss, trained.pairs_seen, trained.commit))
    content = {
        "id": recipe.id,
        "scale": recipe.scale,
        "data": recipe.data,
        "arms": {
            name: {"chosen": chosen(rates), "rates": [vars(rate) for rate in rates]}
            for name, rates in swept.items()
        },
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_json(path, content)
    for name, rates in swept.items():
        if chosen(rates) is None:
            tried = ", ".join(f"{rate.lr:g}" for rate in rates)
            raise CorrmatError(f"{name}: training diverged at every rate: {tried}")
    return swept


def chosen(rates: list[RateResult]) -> float | None:
    """Return the rate with the lowest rotation error on validation; None if all diverged."""
    errors = {rate.lr: rate.rotation_error_deg_mean for rate in rates}
    finite = {lr: error for lr, error in errors.items() if error is not None}
    return min(finite, key=finite.__getitem__, default=None)


def _short(settings: ArmSettings, factor: float) -> ArmSettings:
    """Return an arm's settings with another rate and a twentieth of the steps."""
    lr = float(f"{settings.optimizer.lr * factor:.2g}")
    trainer = deepcopy(settings.trainer)
    trainer.max_steps = max(2, round(trainer.max_steps * BUDGET))
    # At the end: in batches, counted over epochs.
    trainer.val_check_interval = trainer.max_steps * trainer.accumulate_grad_batches
    trainer.check_val_every_n_epoch = None
    return replace(
        settings,
        name=f"{settings.name}-{lr:g}",
        optimizer=replace(settings.optimizer, lr=lr),
        trainer=trainer,
    )
