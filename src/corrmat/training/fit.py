"""Train one arm with Lightning, and score it on the frozen test pairs."""

import logging
import pickle
import statistics
import time
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import lightning as L
import torch
from torch import Tensor

from corrmat.data.datamodule import PairDataset
from corrmat.errors import CorrmatError, DivergedError, cannot_write, short_message
from corrmat.methods import Method
from corrmat.module import RegistrationModule
from corrmat.networks.state import load_state
from corrmat.revision import commit
from corrmat.training import loggers, runs
from corrmat.training.callbacks import (
    MovableCheckpoint,
    PerPairCollector,
    SaveOnInterrupt,
    ValidationHistory,
)
from corrmat.training.console import Board, BoardProgress
from corrmat.training.hardware import (
    describe_hardware,
    first_device,
    is_first_process,
    keep_freed_memory,
    on_gpu,
    resolve_precision,
    trainer_options,
)
from corrmat.training.preflight import Arm, build_method, planned_steps
from corrmat.training.recipe import ArmSettings
from corrmat.training.runs import TrainedArm
from corrmat.weights import load_model

log = logging.getLogger("corrmat")
_TIMED_STEPS = 3
MONITOR = "val/rotation_error_deg_mean"  # the best checkpoint has the lowest


def train(
    arm: Arm,
    folder: Path,
    group: str = "",
    logger: loggers.Choice = "csv",
    board: Board | None = None,
    *,
    fresh: bool = False,
) -> TrainedArm:
    """Train one arm; an interrupted run of the same settings continues.

    Args:
        arm: from `prepare`.
        folder: for checkpoints (best.ckpt on validation, last.ckpt) and logs.
        group: wandb's name for the arms that belong together.
        logger: see `loggers.make_loggers`.
        board: to show progress on.
        fresh: start anew in any case.

    Raises:
        DivergedError: a loss that is not finite.
        CorrmatError: a full disk.
        KeyboardInterrupt: Ctrl-C in the last step; the arm is trained.
    """
    today = commit()
    method = fresh_method(arm.settings)
    resume_from = None if fresh else runs.find_interrupted(folder, arm)
    if resume_from is None:
        size = sum(p.numel() for p in method.parameters())
        log.info(f"{size:,} parameters, {len(arm.datamodule.clouds('train'))} training shapes")
    if is_first_process():
        if resume_from is None:
            runs.set_aside(folder, arm)
        runs.start_run(folder, arm, today)
    else:
        logger, board = "none", None

    history, interrupt = ValidationHistory(), SaveOnInterrupt(folder / "last.ckpt")
    callbacks = [
        history,
        MovableCheckpoint(folder, "best", monitor=MONITOR, enable_version_counter=False),
        MovableCheckpoint(folder, "last", enable_version_counter=False),
        interrupt,
        *([BoardProgress(board, arm.name, history)] if board else []),
    ]
    lightning_loggers = loggers.make_loggers(
        logger, folder, arm.name, group, arm.settings.as_plain()
    )
    keep_freed_memory()
    trainer = L.Trainer(
        **trainer_options(arm.settings),  # pyright: ignore[reportArgumentType]
        logger=lightning_loggers,
        callbacks=callbacks,
        default_root_dir=folder,
    )
    if resume_from is not None:
        log.info(f"continuing from {resume_from}")
    try:
        trainer.fit(method, arm.datamodule, ckpt_path=resume_from, weights_only=True)
    except (CorrmatError, OSError) as error:
        if isinstance(error, OSError) and not cannot_write(error):
            raise
        last = folder / "last.ckpt"
        kept = last if last.is_file() else "none yet"
        kind = DivergedError if isinstance(error, DivergedError) else CorrmatError
        raise kind(f"{error}; seed {arm.settings.seed}; last good checkpoint: {kept}") from error
    finally:  # else wandb would put the next arm's curve into this one's run
        loggers.finish_loggers(lightning_loggers)
    best = folder / "best.ckpt"
    if not best.is_file():
        log.info("training ended before the first validation: the last weights count as the best")
        trainer.save_checkpoint(best)
    trained = TrainedArm(
        best, history.pairs_seen, history.seconds, runs.commits_of(folder), history.points,
        describe_hardware(arm.settings),
    )  # fmt: skip
    if is_first_process():
        runs.finish_run(folder, trained)
    if interrupt.stop_requested:
        raise KeyboardInterrupt
    return trained


def fresh_method(settings: ArmSettings) -> Method:
    """Build the method where training starts: with the weights that its seed gives, or others.

    Raises:
        CorrmatError: the weights to start from are of another network. They may be of a smaller
            one: what they lack starts as the seed gives it.
    """
    L.seed_everything(settings.seed, workers=True, verbose=False)
    method = build_method(settings)
    if settings.start is not None:
        start = load_model(settings.start).state_dict()
        load_state(method.network, method.network.state_dict() | start).train()
    return method


def seconds_to_train(arm: Arm) -> float | None:
    """Estimate how long an arm trains, from a timed step; None on a GPU, or without a last step."""
    settings, trainer = arm.settings, arm.settings.trainer
    steps = planned_steps(arm)
    if steps is None or trainer.max_time is not None or on_gpu(trainer.accelerator):
        return None
    method = fresh_method(settings)
    dataset = arm.datamodule.test_dataloader().dataset
    assert isinstance(dataset, PairDataset)
    batch = dataset.__getitems__([(0, 0)] * arm.datamodule.batch_size)
    bfloat16 = resolve_precision(settings) == "bf16-mixed"
    optimizer = torch.optim.Adam(method.parameters())
    seconds = []
    for _ in range(_TIMED_STEPS):
        start = time.perf_counter()
        with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
            prediction = method(batch.source, batch.target)
        method.loss(prediction, batch).backward()
        optimizer.step()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds) * steps * trainer.accumulate_grad_batches


def load_trained(arm: Arm, checkpoint: Path) -> Method:
    """Build an arm's method with the weights of a checkpoint.

    Options that change no weight may differ from those of its training; they are logged.

    Raises:
        CorrmatError: the checkpoint is missing, unreadable, or of another network.
    """
    method = build_method(arm.settings)
    if not checkpoint.is_file():
        raise CorrmatError(f"no checkpoint {checkpoint}; train first (corrmat fit)")
    others = ""
    try:
        content = torch.load(checkpoint, map_location="cpu", weights_only=True)
        others = _other_options(arm, content.get("hyper_parameters", {}).get("network", {}))
        method.load_state_dict(content["state_dict"])
    except Exception as error:  # unpickling raises errors of every type
        unsafe = isinstance(error, pickle.UnpicklingError)  # torch advises to load it all the same
        reason = others or ("no checkpoint of tensors" if unsafe else short_message(error))
        raise CorrmatError(f"{checkpoint} does not fit these settings: {reason}") from error
    if others:
        log.warning(f"{checkpoint}: {others}")
    return method


def _other_options(arm: Arm, trained: Mapping[str, object]) -> str:
    """Say which options of the network a checkpoint was trained with that an arm has not."""
    now = arm.settings.network.as_dict()
    others = [
        f"--network.{name} {value}, not {now[name]}"
        for name, value in trained.items()
        if name in now and now[name] != value
    ]
    return f"it was trained with {'; '.join(others)}" if others else ""


def score(
    module: RegistrationModule, arm: Arm, changes: Sequence[Mapping[str, float]] = ({},)
) -> list[dict[str, Tensor]]:
    """Score a module on an arm's frozen test pairs, in float32 on one device.

    Args:
        module: that predicts.
        arm: whose pairs.
        changes: fields of `PairSettings` to replace, one set of pairs each.

    Returns:
        Per-pair values of each set, see `RegistrationMetrics.per_pair`, with the category.
    """
    options = trainer_options(arm.settings, "32-true")
    options |= {
        "devices": first_device(arm.settings.trainer.devices), "num_nodes": 1, "strategy": "auto",
        "logger": False, "enable_checkpointing": False, "enable_progress_bar": False,
    }  # fmt: skip
    collector = PerPairCollector()
    trainer = L.Trainer(**options, callbacks=[collector])  # pyright: ignore[reportArgumentType]
    tests = []
    for fields in changes:
        trainer.test(module, arm.datamodule.test_dataloader(**fields), verbose=False)
        labels = torch.from_numpy(arm.datamodule.clouds("test").labels)
        tests.append(collector.per_pair | {"category": labels[collector.per_pair["shape"]]})
    return tests


def silence_libraries() -> None:
    """Keep Lightning's hints and the deprecations inside libraries off the user's screen."""
    for message in (
        "isinstance.treespec, LeafSpec",
        "Checkpoint directory",  # ours holds the logs already
        "resuming from a checkpoint that ended before the epoch",  # the DataModule's state helps
        "does not have many workers",
    ):
        warnings.filterwarnings("ignore", message=f".*{message}")
