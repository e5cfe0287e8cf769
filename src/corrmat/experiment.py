"""A recipe becomes a record: arms trained, tested once on frozen pairs, written to results/."""

import contextlib
import ctypes
import json
import logging
import pickle
import shutil
import warnings
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
import yaml
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.utilities import rank_zero_only
from torch import Tensor

from corrmat import logs, record, report
from corrmat.baselines import BASELINES, UNTRAINED
from corrmat.callbacks import Bfloat16, Curve, SaveOnInterrupt, WholeCheckpoints, say
from corrmat.console import Board, Progress
from corrmat.data.datamodule import PairDataset, RegistrationDataModule
from corrmat.errors import CorrmatError
from corrmat.files import ensure_writable, replace_text
from corrmat.losses import CorrespondenceLoss
from corrmat.methods import METHODS
from corrmat.module import OptimizerSettings, RegistrationModule
from corrmat.recipe import Recipe

log = logging.getLogger("corrmat")
Settings = Any  # jsonargparse.Namespace with seed, data, network, optimizer, trainer
BEST = "val/rotation_error_deg_mean"
_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # of glibc's malloc.h
RECORDED = "recorded"  # marks an arm whose record is written: the next run trains anew


@dataclass
class Trained:
    """An arm after training."""

    checkpoint: Path
    pairs_seen: int
    train_seconds: float
    commit: str | None
    curve: list[dict[str, float]] = field(default_factory=list)
    hardware: dict[str, Any] = field(default_factory=dict)


@dataclass
class Arm:
    """An arm that can be trained: its settings have been tried, its shapes are read."""

    name: str
    settings: Settings
    datamodule: RegistrationDataModule


def prepare(name: str, settings: Settings) -> Arm:
    """Build everything that settings can get wrong, before a run deletes or writes anything.

    Raises:
        CorrmatError: data that cannot be read, a network or Trainer that cannot be built.
    """
    if not 0 <= settings.seed < 2**32:
        raise CorrmatError(f"seed {settings.seed} is not between 0 and 2^32")
    arm = Arm(name, settings, make_datamodule(settings))
    module = make_module(settings)
    network: Any = module.network
    needed, points = network.min_points, arm.datamodule.how.num_source
    if points < needed:
        raise CorrmatError(
            f"a source of {points} points is too small for {settings.method}, which needs "
            f"{needed}; raise --data.num_points or lower --network.k"
        )
    arm.datamodule.setup()
    _refuse_schedules(arm)
    _refuse_validation(arm)
    _try(module, arm)
    try:
        L.Trainer(**trainer_options(settings), logger=False)
    except (MisconfigurationException, ValueError, TypeError) as error:
        first = str(error).splitlines()[0]
        raise CorrmatError(f"no Trainer of these --trainer options: {first}") from error
    return arm


def _refuse_schedules(arm: Arm) -> None:
    """A rate that never ends or never rises; no step at all; gradients that cannot be clipped."""
    trainer, rate = arm.settings.trainer, arm.settings.optimizer
    if trainer.accumulate_grad_batches < 1:
        raise CorrmatError(
            f"--trainer.accumulate_grad_batches {trainer.accumulate_grad_batches} is not positive"
        )
    for name in ("max_steps", "max_epochs", "limit_train_batches", "limit_test_batches"):
        if getattr(trainer, name) == 0:
            raise CorrmatError(f"--trainer.{name} 0 leaves nothing to do")
    timed = trainer.max_time is not None and trainer.max_epochs is None
    endless = trainer.max_steps == -1 and (trainer.max_epochs == -1 or timed)
    if rate.schedule == "onecycle":
        if endless:
            raise CorrmatError("a one-cycle learning rate needs --trainer.max_steps or max_epochs")
        if trainer.max_steps * rate.warmup == 1:  # torch divides by the steps after the first
            raise CorrmatError(
                f"a one-cycle learning rate cannot rise in one step, {rate.warmup:g} of "
                f"--trainer.max_steps {trainer.max_steps}: change either"
            )
    if trainer.gradient_clip_val and str(trainer.precision) in ("16", "16-mixed"):
        raise CorrmatError(
            f"--trainer.precision {trainer.precision} cannot clip gradients: take bf16-mixed, or "
            "--trainer.gradient_clip_val null"
        )


def _refuse_validation(arm: Arm) -> None:
    """Validation that never comes; checkpoints, written after it, in the middle of a step."""
    trainer, data = arm.settings.trainer, arm.datamodule
    processes, held_out = _devices(trainer.devices) * trainer.num_nodes, len(data.clouds("val"))
    if processes > held_out:
        raise CorrmatError(
            f"{processes} processes cannot share {held_out} held-out shapes: lower "
            "--trainer.devices, or raise --data.train_shapes"
        )
    together, interval = trainer.accumulate_grad_batches, trainer.val_check_interval
    batches = len(data.train_dataloader())
    if trainer.check_val_every_n_epoch is not None and isinstance(interval, int | float):
        least = interval if isinstance(interval, int) else 1 / interval
        if least > batches:
            raise CorrmatError(
                f"--trainer.val_check_interval {interval} never comes in epochs of {batches} "
                "batches; --trainer.check_val_every_n_epoch null counts over epochs"
            )
    if together == 1 or interval is None or (isinstance(interval, float) and interval == 1):
        return  # validated after steps, or whole epochs
    between = [interval]
    if trainer.check_val_every_n_epoch is None:  # batches are counted over epochs
        between.append(batches)
    if any(number % together for number in between):
        raise CorrmatError(
            f"with --trainer.accumulate_grad_batches {together}, validation after {interval} "
            "batches would write checkpoints in the middle of a step: choose a number that divides "
            + " and ".join(f"{number:g}" for number in between)
        )


@torch.no_grad()
def _try(module: RegistrationModule, arm: Arm) -> None:
    """One pair through a network, as in training and as in a test."""
    dataset = arm.datamodule.test_dataloader().dataset
    assert isinstance(dataset, PairDataset)
    pair = dataset.__getitems__([(0, 0)] * 2)
    try:
        for training in (True, False):
            module.train(training)
            module.loss(module(pair.source, pair.target), pair)
    except (RuntimeError, ValueError, ArithmeticError, LookupError) as error:
        said = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CorrmatError(f"no network of these --network options: {said}") from error


def run(
    recipe: Recipe,
    results: Path,
    runs: Path,
    logger: logs.Choice = "csv",
    *,
    fresh: bool = False,
) -> dict[str, Any]:
    """Train and test every arm, and write the record when all are done.

    Args:
        recipe: the experiment.
        results: folder of records; this one goes to <scale>/<data>/<id>.
        runs: folder of checkpoints and logs, the same below it.
        logger: see `logs.loggers`.
        fresh: start anew where a run was interrupted or an arm is trained already.

    Returns:
        The record, as in metrics.json; nothing in the further processes of a distributed run.
    """
    place = Path(recipe.scale, recipe.data, recipe.id)
    for folder in (results / place, runs / place):
        ensure_writable(folder)
    ready = [prepare(name, settings) for name, settings in recipe.settings.items()]
    test_pairs = ready[0].datamodule.checksum(bands(recipe.bands_deg))
    if recipe.test_pairs not in (None, test_pairs):
        log.warning(
            "the test pairs made here (%s) are not the recipe's (%s): numbers compare with other "
            "records in the mean only", test_pairs, recipe.test_pairs,
        )  # fmt: skip
    scores, rows, views, hardware = {}, [], [], []
    with Board() as board:
        for arm in ready:
            say(f"\n{recipe.id} {arm.name} ({recipe.scale}, {recipe.data})")
            folder = runs / place / arm.name
            trained = None if fresh else trained_already(recipe, arm, runs)
            trained = trained or train(arm, folder, str(place), logger, board, fresh=fresh)
            if not first_process():  # the others of a distributed run are there to train
                continue
            module = trained_module(arm, trained.checkpoint)
            tests, scored = _tested(module, arm, recipe)
            scores[arm.name] = scored | {
                "pairs_seen": trained.pairs_seen,
                "train_seconds": round(trained.train_seconds, 1),
                "trained_at": trained.commit,
                "curve": trained.curve,
            }
            hardware.append(trained.hardware)
            rows += record.rows(arm.name, tests)
            views = views or _views(module, arm, tests, recipe)
    if not first_process():
        return {}
    baselines = {}
    for name in recipe.baselines:
        tests, baselines[name] = _tested(_baseline(name, ready[-1]), ready[-1], recipe)
        rows += record.rows(name, tests)
    found = {
        "id": recipe.id,
        "title": recipe.title,
        "scale": recipe.scale,
        "data": recipe.data,
        "seed": ready[0].settings.seed,
        "commit": record.commit(),
        "hardware": _together(hardware),
        "versions": {name: version(name) for name in ("corrmat", "torch", "lightning", "numpy")},
        "test_pairs": test_pairs,
        "bands_deg": list(recipe.bands_deg),
        "arms": scores,
        "baselines": baselines,
        "paper": recipe.paper,
    }
    record.write(results / place, found, recipe, rows, views)
    for arm in ready:
        if (runs / place / arm.name).is_dir():
            (runs / place / arm.name / RECORDED).touch()
    logs.send_record(logger, runs / place, found, views, results / place)
    print(report.terminal_table(found), flush=True)
    say(f"record: {results / place}")
    return found


def train(
    arm: Arm,
    folder: Path,
    group: str = "",
    logger: logs.Choice = "csv",
    board: Board | None = None,
    *,
    fresh: bool = False,
) -> Trained:
    """Train one arm; goes on from an interrupted run of the same settings if there is one.

    Args:
        arm: from `prepare`.
        folder: for checkpoints (best.ckpt on validation, last.ckpt) and logs.
        group: wandb's name for the arms that belong together.
        logger: see `logs.loggers`.
        board: to show progress on.
        fresh: start anew in any case.

    Raises:
        CorrmatError: a loss that is no longer a number; a full disk.
    """
    settings, datamodule = arm.settings, arm.datamodule
    module = _fresh(settings)
    text = training_settings(arm)
    last, done = folder / "last.ckpt", folder / "trained.json"
    interrupted = not done.is_file() and _settings(folder) == text
    start = _last_good(folder) if interrupted and not fresh else None
    if start is None:
        size, shapes = sum(p.numel() for p in module.parameters()), datamodule.clouds("train")
        say(f"{size:,} parameters, {len(shapes)} training shapes")
    if first_process():
        if start is None:
            shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True, exist_ok=True)
        replace_text(folder / "settings.yaml", text)
    else:
        logger, board = "none", None

    curve, interrupt = Curve(), SaveOnInterrupt(last)
    callbacks = [
        curve,
        ModelCheckpoint(folder, "best", monitor=BEST, enable_version_counter=False),
        ModelCheckpoint(folder, "last", enable_version_counter=False),
        interrupt,
        *([Progress(board, arm.name, curve)] if board else []),
    ]
    config = report.plain(settings.as_dict())
    made = logs.loggers(logger, folder, arm.name, group, config)
    options = trainer_options(settings)
    keep_freed_memory()
    trainer = L.Trainer(**options, logger=made, callbacks=callbacks, default_root_dir=folder)
    datamodule.trainer = trainer
    if start is not None:
        datamodule.goes_on = _progress(start, datamodule)
        say(f"going on from {start}")
    try:
        trainer.fit(module, datamodule, ckpt_path=start, weights_only=True)
    except (CorrmatError, OSError) as error:
        kept = last if last.is_file() else "none yet"
        raise CorrmatError(
            f"{error}; seed {settings.seed}; last good checkpoint: {kept}"
        ) from error
    logs.finish(made)
    checkpoint = folder / "best.ckpt"
    if not checkpoint.is_file():
        say("training ended before the first validation: the last weights stand for the best")
        trainer.save_checkpoint(checkpoint)
    hardware = {
        "threads": torch.get_num_threads(),
        "gpu": _on_gpu(settings.trainer.accelerator),
        "precision": _precision(settings),
    }
    trained = Trained(
        checkpoint, curve.pairs, curve.seconds, record.commit(), curve.points, hardware
    )
    if first_process():
        replace_text(
            done, json.dumps(asdict(trained) | {"checkpoint": trained.checkpoint.name}, indent=1)
        )
    if interrupt.noted:
        raise KeyboardInterrupt
    return trained


def _together(arms: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What all arms were trained on; "a / b" where one differs from another."""
    found = {}
    for key in arms[0]:
        values = list(dict.fromkeys(arm.get(key) for arm in arms))
        found[key] = values[0] if len(values) == 1 else " / ".join(map(str, values))
    return found


def first_process() -> bool:
    """Whether this process writes: the only one, or the first of those that train together."""
    return not rank_zero_only.rank


def trained_module(arm: Arm, checkpoint: Path) -> RegistrationModule:
    """An arm's module with the weights of a checkpoint."""
    module = make_module(arm.settings)
    load_weights(module, checkpoint)
    return module


def bands(edges_deg: tuple[float, ...]) -> list[dict[str, float]]:
    """How test pairs are drawn for rotation bands; once and as in training if there are none.

    With bands their angles lie between neighbouring edges and there is no translation (tables
    1 and 2 of the paper).
    """
    return [
        {"min_rotation_deg": low, "rotation_deg": high, "translation": 0.0}
        for low, high in zip(edges_deg, edges_deg[1:], strict=False)
    ] or [{}]


def score(
    module: RegistrationModule, arm: Arm, how: Sequence[dict[str, float]] = ({},)
) -> list[dict[str, Tensor]]:
    """Score a module on an arm's frozen test pairs.

    Args:
        module: what predicts.
        arm: whose pairs.
        how: changes to how the pairs are drawn (fields of `PairSettings`), one set of pairs each.

    Returns:
        Per-pair values of each set.
    """
    options = trainer_options(arm.settings, "32-true")
    alone = {"devices": _first(options["devices"]), "num_nodes": 1, "strategy": "auto"}
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    trainer = L.Trainer(**{**options, **alone, **quiet})
    found = []
    for changes in how:
        trainer.test(module, arm.datamodule.test_dataloader(**changes), verbose=False)
        found.append(module.metrics.per_pair())
        names = arm.datamodule.clouds("test")
        found[-1]["category"] = torch.from_numpy(names.labels)[found[-1]["shape"]]
        module.metrics.reset()
    return found


def _first(devices: int | str | list[int]) -> int | list[int]:
    """One device: the first of those that settings name, or any."""
    named = _named(devices)
    return named[:1] if isinstance(named, list) else 1


def _devices(devices: int | str | list[int]) -> int:
    """How many devices settings ask for; 0 where that is left to Lightning."""
    named = _named(devices)
    if isinstance(named, list):
        return len(named)
    return max(0, int(named)) if str(named).lstrip("-").isdigit() else 0


def _named(devices: int | str | list[int]) -> int | str | list[int]:
    """Devices as Lightning takes them: "2,3" names two, as a list does."""
    if isinstance(devices, str) and "," in devices:
        return [int(name) for name in devices.split(",") if name.strip()]
    return devices


def _tested(
    module: RegistrationModule, arm: Arm, recipe: Recipe
) -> tuple[list[dict[str, Tensor]], dict[str, Any]]:
    """Per-pair values, one set a rotation band, and the metrics of all that a recipe asks for."""
    tests = score(module, arm, bands(recipe.bands_deg))
    shares = recipe.sweep_outliers
    sweep = score(module, arm, [{"outliers": share} for share in shares]) if shares else []
    return tests, record.scores(tests, recipe.bands_deg, dict(zip(shares, sweep, strict=True)))


def make_datamodule(settings: Settings) -> RegistrationDataModule:
    """The pairs of these settings."""
    return RegistrationDataModule(**settings.data.as_dict(), seed=settings.seed)


def make_module(settings: Settings) -> RegistrationModule:
    """The method of these settings, freshly initialised.

    Raises:
        CorrmatError: the network cannot be built so.
    """
    method = METHODS[settings.method]
    try:
        network: Any = method.network_type(**settings.network.as_dict())
    except (ValueError, RuntimeError, ArithmeticError) as error:
        raise CorrmatError(f"no network of these --network options: {error}") from error
    return method(network, OptimizerSettings(**settings.optimizer.as_dict()))


def _fresh(settings: Settings) -> RegistrationModule:
    """`make_module` with the weights that the seed gives: what training starts from."""
    L.seed_everything(settings.seed, workers=True, verbose=False)
    return make_module(settings)


@torch.no_grad()
def _views(
    module: RegistrationModule, arm: Arm, tests: list[dict[str, Tensor]], recipe: Recipe
) -> list[dict[str, Any]]:
    """The pairs that a METHOD_corr finds easiest, middling and hardest, to be looked at."""
    if not isinstance(module, CorrespondenceLoss):
        return []
    module.cpu().eval()
    size = len(tests[0]["shape"])  # of every band
    errors = torch.cat([found["rotation_error_deg"] for found in tests])
    order = errors.argsort().tolist()
    found = []
    for rank, place in (("easiest", 0), ("median", len(order) // 2), ("hardest", -1)):
        part, index = divmod(order[place], size)
        pairs = arm.datamodule.test_dataloader(**bands(recipe.bands_deg)[part]).dataset
        pair = pairs[(0, index)]
        prediction = module(pair.source, pair.target)
        error = float(errors[order[place]])
        found.append(record.view(arm.name, rank, error, pair, prediction))
    return found


def _baseline(name: str, arm: Arm) -> RegistrationModule:
    if name == UNTRAINED:
        return _fresh(arm.settings)
    return RegistrationModule(BASELINES[name](), OptimizerSettings())


def best_checkpoint(recipe: Recipe, arm: Arm, runs: Path) -> Path:
    """Where the best weights of an arm lie: its own, or the same arm's of `networks_of`."""
    own, *others = _folders(recipe, arm, runs)
    same = [folder for folder in others if _settings(folder) == training_settings(arm)]
    found = [folder / "best.ckpt" for folder in (own, *same)]
    return next((path for path in found if path.is_file()), found[0])


def load_weights(module: RegistrationModule, checkpoint: Path) -> None:
    """Fill a module from a Lightning checkpoint; nothing but tensors is unpickled.

    Raises:
        CorrmatError: it is missing, unreadable, or of another network.
    """
    if not checkpoint.is_file():
        raise CorrmatError(f"no checkpoint {checkpoint}; train first (corrmat fit)")
    try:
        state = torch.load(checkpoint, map_location="cpu", weights_only=True)["state_dict"]
        module.load_state_dict(state)
    except Exception as error:
        first = str(error).splitlines()[0]
        raise CorrmatError(f"{checkpoint} does not fit these settings: {first}") from error


def quieten() -> None:
    """Keep Lightning's hints and the deprecations inside libraries off the user's screen."""
    for message in (
        "isinstance.treespec, LeafSpec",
        "Checkpoint directory",  # ours holds the logs already
        "resuming from a checkpoint that ended before the epoch",  # `goes_on` sees to it
        "does not have many workers",
    ):
        warnings.filterwarnings("ignore", message=f".*{message}")


def trainer_options(settings: Settings, precision: str | None = None) -> dict[str, Any]:
    """Keyword arguments of Lightning's Trainer; the settings' precision, or another."""
    options = settings.trainer.as_dict()
    options |= {"enable_model_summary": False, "enable_checkpointing": True}
    options["use_distributed_sampler"] = False  # `EpochSampler` shares the pairs out
    options["plugins"] = [WholeCheckpoints()]
    options["enable_progress_bar"] = bool(options.get("enable_progress_bar"))  # ours is the board
    if options["accelerator"] == "auto" and torch.backends.mps.is_available():
        options["accelerator"] = "cpu"  # Apple's GPUs lack the float64 that Procrustes needs
    options["precision"] = precision or _precision(settings)
    if options["precision"] == "bf16-mixed" and "fsdp" not in str(options["strategy"]):
        options["precision"] = None  # the plugin's
        options["plugins"].append(Bfloat16("cuda" if _on_gpu(options["accelerator"]) else "cpu"))
    return options


def _on_gpu(accelerator: str) -> bool:
    return torch.cuda.is_available() and accelerator in ("auto", "gpu", "cuda")


def _precision(settings: Settings) -> str:
    return str(settings.trainer.precision or default_precision(settings.trainer.accelerator))


def default_precision(accelerator: str) -> str:
    """What to train in, by Lightning's name: bfloat16 products where they are fast.

    Logits, moments, Procrustes and losses stay in float32 or wider, and so do all tests.

    Args:
        accelerator: as Lightning's Trainer takes it.
    """
    if _on_gpu(accelerator):
        fast = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        fast = getattr(torch.cpu, "get_capabilities", dict)().get("avx512_bf16", False)
    return "bf16-mixed" if fast else "32-true"


def keep_freed_memory() -> None:
    """Tell glibc to keep the blocks that a training step frees for the next step.

    It would hand the large ones back to the kernel, which clears them anew every time: up to a
    quarter of a CPU step. Of no effect where the C library is another.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):
        library = ctypes.CDLL(None)
        library.mallopt(_M_MMAP_MAX, 0)
        library.mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)


def training_settings(arm: Arm) -> str:
    """What decides how an arm is trained, as YAML: settings and a checksum of the shapes.

    Not in it: where the data lies, how many processes read it, and what is tested.
    """
    plain = report.plain(arm.settings.as_dict())
    for name in ("root", "num_workers", "test_shapes"):
        del plain["data"][name]
    rows = arm.datamodule.clouds("train").rows
    plain["data"]["checksum"] = f"{zlib.crc32(np.ascontiguousarray(rows).data):08x}"
    return yaml.safe_dump(plain, sort_keys=False)


def _last_good(folder: Path) -> Path | None:
    """The checkpoint to go on from: the last, or the best where the last was cut short."""
    for checkpoint in (folder / "last.ckpt", folder / "best.ckpt"):
        if checkpoint.is_file():
            try:
                torch.load(checkpoint, map_location="cpu", weights_only=True, mmap=True)
            except (RuntimeError, OSError, ValueError, EOFError, pickle.UnpicklingError):
                say(f"{checkpoint} cannot be read and is left out")
            else:
                return checkpoint
    return None


def _progress(checkpoint: Path, datamodule: RegistrationDataModule) -> dict[str, int]:
    """The epoch that a checkpoint was written in, and how many of its items it has seen."""
    content = torch.load(checkpoint, map_location="cpu", weights_only=True)
    seen = content["loops"]["fit_loop"]["epoch_loop.batch_progress"]["current"]["completed"]
    seen %= len(datamodule.train_dataloader())  # a whole epoch seen: the next one is whole too
    return {"epoch": content["epoch"], "done": seen * datamodule.batch_size}


def trained_already(recipe: Recipe, arm: Arm, runs: Path) -> Trained | None:
    """The same arm, trained to the end with the same settings before.

    Either by this experiment, if its record is not written yet, or by the one that `networks_of`
    names.
    """
    own, *others = _folders(recipe, arm, runs)
    for folder in (*([] if (own / RECORDED).exists() else [own]), *others):
        done = folder / "trained.json"
        if done.is_file() and _settings(folder) == training_settings(arm):
            say(f"trained already: {folder}")
            content = json.loads(done.read_text())
            return Trained(**content | {"checkpoint": folder / content["checkpoint"]})
    return None


def _folders(recipe: Recipe, arm: Arm, runs: Path) -> list[Path]:
    """Where an arm is trained: by this experiment, and by the one that `networks_of` names."""
    identities = filter(None, (recipe.id, recipe.networks_of))
    return [runs / recipe.scale / recipe.data / identity / arm.name for identity in identities]


def _settings(folder: Path) -> str | None:
    stored = folder / "settings.yaml"
    return stored.read_text() if stored.is_file() else None
