"""Preflight checks: what would fail late in a run fails before it starts."""

import inspect
import math
from dataclasses import dataclass

import lightning as L
import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException

from corrmat.data.datamodule import PairDataset, RegistrationDataModule
from corrmat.errors import CorrmatError
from corrmat.methods import METHODS, Method
from corrmat.training.hardware import trainer_options
from corrmat.training.recipe import ArmSettings
from corrmat.types import Prediction, fewest_points

# Options of the Trainer that cut the frozen test pairs, that checkpoints cannot go on from, or that
# replace layers which networks/ computes in a way of its own.
_UNSUPPORTED = (
    "fast_dev_run", "overfit_batches", "limit_test_batches", "reload_dataloaders_every_n_epochs",
    "min_steps", "min_epochs", "barebones", "sync_batchnorm",
)  # fmt: skip


@dataclass
class Arm:
    """An arm that can be trained: its settings are checked and its shapes are open."""

    name: str
    settings: ArmSettings
    datamodule: RegistrationDataModule
    processes: int  # that train together


def prepare(settings: ArmSettings) -> Arm:
    """Build everything that settings configure, before a run deletes or writes anything.

    Raises:
        CorrmatError: data that cannot be read, a network or Trainer that cannot be built.
        Exception: whatever a network or loss raises on its first pair; it is not reworded.
    """
    if not 0 <= settings.seed < 2**32:
        raise CorrmatError(f"seed {settings.seed} is not between 0 and 2^32")
    method = build_method(settings)
    try:
        trainer = L.Trainer(**trainer_options(settings), logger=False)  # pyright: ignore[reportArgumentType]
    except (MisconfigurationException, ValueError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise CorrmatError(
            f"cannot build a Trainer from the --trainer options: {reason}"
        ) from error
    datamodule = RegistrationDataModule(**settings.data.as_dict(), seed=settings.seed)
    arm = Arm(settings.name, settings, datamodule, trainer.world_size)
    required, points = fewest_points(method.network), datamodule.pairs.num_source
    if points < required:
        raise CorrmatError(
            f"a source of {points} points is too small for {settings.method}, which needs "
            f"{required}; raise --data.num_points or lower --network.k"
        )
    datamodule.setup()
    _check_processes(arm)
    _check_optimization(arm)
    _check_validation(arm)
    _try_one_batch(method, arm)
    return arm


def build_method(settings: ArmSettings) -> Method:
    """Build the method of these settings, freshly initialised.

    Raises:
        CorrmatError: the network or loss refuses these options. Whatever else a network of the
            user's own raises is not reworded.
    """
    network, loss = settings.network.as_dict(), settings.loss.as_dict()
    method = METHODS[settings.method]
    try:
        return method(network, loss, settings.optimizer)
    except CorrmatError as error:
        raise CorrmatError(
            f"cannot build {settings.method} from the --network options: {error}"
        ) from error


def planned_steps(arm: Arm) -> int | None:
    """Count the optimizer's steps in an arm's training; None if it has no end that steps know."""
    trainer = arm.settings.trainer
    batches = _limited(_train_batches(arm), trainer.limit_train_batches)
    ends = [] if trainer.max_steps == -1 else [trainer.max_steps]
    if trainer.max_epochs not in (None, -1):
        ends.append(trainer.max_epochs * math.ceil(batches / trainer.accumulate_grad_batches))
    return min(ends, default=None)


def _train_batches(arm: Arm) -> int:
    """Count the batches of an epoch in each process."""
    return arm.datamodule.count_train_batches(arm.processes)


def _limited(batches: int, limit: float | None) -> int:
    """Count the batches that a limit of the Trainer leaves: a number, or a share if no integer."""
    if limit is None:
        return batches
    return min(batches, limit) if isinstance(limit, int) else int(batches * limit)


def _check_processes(arm: Arm) -> None:
    """Reject more processes than there are shapes for each to validate on."""
    held_out = len(arm.datamodule.clouds("val"))
    if arm.processes > held_out:
        raise CorrmatError(
            f"{arm.processes} processes cannot share {held_out} held-out shapes: lower "
            "--trainer.devices, or raise --data.train_shapes"
        )


def _check_optimization(arm: Arm) -> None:
    """Reject optimizer settings that Lightning would only fail on after training has started."""
    trainer, optimizer = arm.settings.trainer, arm.settings.optimizer
    for name in _UNSUPPORTED:
        if getattr(trainer, name) != inspect.signature(L.Trainer).parameters[name].default:
            raise CorrmatError(f"--trainer.{name} does not go with records; try --scale smoke")
    if trainer.accumulate_grad_batches < 1:
        raise CorrmatError(
            f"--trainer.accumulate_grad_batches {trainer.accumulate_grad_batches} is not positive"
        )
    left = {
        "max_steps": trainer.max_steps,
        "max_epochs": trainer.max_epochs,
        "val_check_interval": trainer.val_check_interval,
        "limit_train_batches": _limited(_train_batches(arm), trainer.limit_train_batches),
        "limit_val_batches": _limited(
            len(arm.datamodule.val_dataloader()), trainer.limit_val_batches
        ),
    }
    for name, count in left.items():
        if count == 0:
            raise CorrmatError(f"--trainer.{name} {getattr(trainer, name):g} leaves nothing to do")
    timed = trainer.max_time is not None and trainer.max_epochs is None
    endless = trainer.max_steps == -1 and (trainer.max_epochs == -1 or timed)
    if endless and optimizer.freeze_norms < 1:
        raise CorrmatError(
            "--optimizer.freeze_norms, a share of the run, needs --trainer.max_steps or max_epochs"
        )
    if optimizer.schedule == "onecycle":
        if endless:
            raise CorrmatError("a one-cycle learning rate needs --trainer.max_steps or max_epochs")
        steps = planned_steps(arm)
        if steps is not None and steps * optimizer.warmup == 1:  # torch divides by those after it
            raise CorrmatError(
                f"a one-cycle learning rate cannot rise in one step, {optimizer.warmup:g} of "
                f"{steps} steps: change --optimizer.warmup or the number of steps"
            )
    if trainer.gradient_clip_val and str(trainer.precision) == "16-mixed":
        raise CorrmatError(
            f"--trainer.precision {trainer.precision} cannot clip gradients: take bf16-mixed, or "
            "--trainer.gradient_clip_val null"
        )


def _check_validation(arm: Arm) -> None:
    """Reject validation that never comes, or that would save checkpoints within a step."""
    trainer = arm.settings.trainer
    accumulate, interval = trainer.accumulate_grad_batches, trainer.val_check_interval
    if not isinstance(interval, int | float | None):
        raise CorrmatError(f"--trainer.val_check_interval {interval} is not a number of batches")
    batches = _limited(_train_batches(arm), trainer.limit_train_batches)
    if trainer.check_val_every_n_epoch is not None and interval is not None:
        least = interval if isinstance(interval, int) else 1 / interval
        if least > batches:
            raise CorrmatError(
                f"--trainer.val_check_interval {interval} never comes in epochs of {batches} "
                "batches; --trainer.check_val_every_n_epoch null counts over epochs"
            )
    if accumulate == 1 or interval is None or (isinstance(interval, float) and interval == 1):
        return  # validation follows whole steps, or whole epochs
    boundaries = [interval]
    if trainer.check_val_every_n_epoch is None:  # batches are counted over epochs
        boundaries.append(batches)
    if any(number % accumulate for number in boundaries):
        raise CorrmatError(
            f"with --trainer.accumulate_grad_batches {accumulate}, validation after {interval} "
            "batches would write checkpoints in the middle of a step: choose a number that divides "
            + " and ".join(f"{number:g}" for number in boundaries)
        )


@torch.no_grad()
def _try_one_batch(method: Method, arm: Arm) -> None:
    """Run one batch through network and loss, as in training and as in a test."""
    dataset = arm.datamodule.test_dataloader().dataset
    assert isinstance(dataset, PairDataset)
    batch = dataset.__getitems__([(0, 0)] * 2)
    for training in (True, False):
        method.train(training)
        prediction = method(batch.source, batch.target)
        if not isinstance(prediction, Prediction):
            network, returned = (type(x).__name__ for x in (method.network, prediction))
            raise TypeError(f"{network}.forward must return a corrmat.Prediction, not a {returned}")
        method.loss(prediction, batch)
