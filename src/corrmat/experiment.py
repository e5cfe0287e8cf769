"""A recipe becomes a record: arms trained, tested once on frozen pairs, written to results/."""

import csv
import json
import logging
import os
import shutil
import subprocess
import sys
import time
import warnings
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import lightning as L
import torch
import yaml
from lightning.pytorch.callbacks import Callback, ModelCheckpoint, TQDMProgressBar
from lightning.pytorch.loggers import CSVLogger, Logger, WandbLogger
from torch import Tensor

from corrmat import metrics, report
from corrmat.data.datamodule import RegistrationDataModule
from corrmat.errors import CorrmatError
from corrmat.methods import METHODS
from corrmat.module import OptimizerSettings, RegistrationModule
from corrmat.recipe import Recipe
from corrmat.types import PairBatch

Settings = Any  # jsonargparse.Namespace with seed, data, network, optimizer, trainer
BEST = "val/rotation_error_deg_mean"


@dataclass
class Trained:
    """An arm after training."""

    checkpoint: Path
    pairs_seen: int
    train_seconds: float
    commit: str | None
    curve: list[dict[str, float]] = field(default_factory=list)


def run(recipe: Recipe, results: Path, runs: Path) -> dict[str, Any]:
    """Train and test every arm, and write the record at one stroke when all are done.

    Args:
        recipe: the experiment.
        results: folder of records; this one goes to <scale>/<data>/<id>.
        runs: folder of checkpoints and logs, the same below it.

    Returns:
        The record, as in metrics.json.
    """
    place = Path(recipe.scale, recipe.data, recipe.id)
    arms, rows = {}, []
    for arm, settings in recipe.settings.items():
        say(f"\n{recipe.id} {arm} ({recipe.scale}, {recipe.data})")
        trained = _trained_elsewhere(recipe, arm, settings, runs)
        if trained is None:
            trained = train(arm, settings, runs / place / arm, group=str(place))
        tests = test(arm, settings, trained.checkpoint, recipe.bands_deg)
        arms[arm] = _scores(tests, recipe.bands_deg) | {
            "pairs_seen": trained.pairs_seen,
            "train_seconds": round(trained.train_seconds, 1),
            "trained_at": trained.commit,
            "curve": trained.curve,
        }
        rows += [row for number, found in enumerate(tests) for row in _rows(arm, number, found)]
    record = {
        "id": recipe.id,
        "title": recipe.title,
        "scale": recipe.scale,
        "data": recipe.data,
        "seed": next(iter(recipe.settings.values())).seed,
        "commit": commit(),
        "hardware": {"threads": torch.get_num_threads(), "gpu": torch.cuda.is_available()},
        "bands_deg": list(recipe.bands_deg),
        "arms": arms,
        "paper": recipe.paper,
    }
    _write(results / place, record, recipe, rows)
    say(report.terminal_table(record))
    say(f"record: {results / place}")
    return record


def train(arm: str, settings: Settings, folder: Path, group: str = "") -> Trained:
    """Train one arm; goes on from an interrupted run of the same settings if there is one.

    Args:
        arm: a key of `METHODS`.
        settings: its seed, data, network, optimizer and trainer.
        folder: for checkpoints (best.ckpt on validation, last.ckpt) and logs.
        group: wandb's name for the arms that belong together.

    Raises:
        CorrmatError: bad data or settings, or a loss that is no longer a number.
    """
    datamodule = make_datamodule(settings)
    datamodule.setup("fit")
    stored = folder / "settings.yaml"
    text = yaml.safe_dump(training_settings(settings), sort_keys=False)
    last, done = folder / "last.ckpt", folder / "trained.json"
    resume = (
        last.is_file() and not done.is_file() and stored.is_file() and stored.read_text() == text
    )
    if not resume:
        shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    stored.write_text(text)

    L.seed_everything(settings.seed, workers=True, verbose=False)
    module = make_module(arm, settings)
    curve = Curve(datamodule.batch_size)
    best = ModelCheckpoint(
        folder, "best", monitor=BEST, save_last=True, enable_version_counter=False
    )
    trainer = make_trainer(settings, folder, [curve, best, SaveOnInterrupt(last)], arm, group)
    if resume:
        say(f"going on from {last}")
    elif trainer.is_global_zero:
        say(
            f"{sum(p.numel() for p in module.parameters()):,} parameters, {len(datamodule.clouds('train'))} training shapes"
        )
    trainer.fit(module, datamodule, ckpt_path=last if resume else None, weights_only=True)
    for logger in trainer.loggers:
        if isinstance(logger, WandbLogger):
            logger.experiment.finish()
    checkpoint = folder / "best.ckpt"
    if not checkpoint.is_file():
        say("training ended before the first validation: the last weights stand for the best")
        trainer.save_checkpoint(checkpoint)
    trained = Trained(checkpoint, curve.pairs, curve.seconds, commit(), curve.points)
    replace_text(
        done, json.dumps(asdict(trained) | {"checkpoint": trained.checkpoint.name}, indent=1)
    )
    return trained


def test(
    arm: str, settings: Settings, checkpoint: Path, bands_deg: tuple[float, ...] = ()
) -> list[dict[str, Tensor]]:
    """Score a checkpoint on the frozen test pairs; per-pair values, one set a rotation band.

    Without bands the pairs are drawn as in training. With bands their angles lie between
    neighbouring edges and there is no translation (tables 1 and 2 of the paper).
    """
    datamodule, module = make_datamodule(settings), make_module(arm, settings)
    load_weights(module, checkpoint)
    how: list[dict[str, float]] = [
        {"min_rotation_deg": low, "rotation_deg": high, "translation": 0.0}
        for low, high in zip(bands_deg, bands_deg[1:], strict=False)
    ]
    quiet = {"logger": False, "enable_checkpointing": False, "enable_model_summary": False}
    trainer = L.Trainer(**{**trainer_options(settings), "enable_progress_bar": False, **quiet})
    found = []
    for changes in how or [{}]:
        trainer.test(module, datamodule.test_dataloader(**changes), verbose=False)
        found.append(module.metrics.per_pair())
        names = datamodule.clouds("test")
        found[-1]["category"] = torch.from_numpy(names.labels)[found[-1]["shape"]]
        module.metrics.reset()
    return found


def make_datamodule(settings: Settings) -> RegistrationDataModule:
    """The pairs of these settings."""
    return RegistrationDataModule(**settings.data.as_dict(), seed=settings.seed)


def make_module(arm: str, settings: Settings) -> RegistrationModule:
    """The method of these settings, freshly initialised.

    Raises:
        CorrmatError: the network cannot be built so, or the clouds are too small for it.
    """
    method = METHODS[arm]
    try:
        network = method.network_type(**settings.network.as_dict())
    except ValueError as error:
        raise CorrmatError(f"no network of these --network options: {error}") from error
    points = make_datamodule(settings).how.num_source
    if points < network.min_points:
        raise CorrmatError(
            f"a source of {points} points is too small for {arm}, which needs {network.min_points}; "
            "raise --data.num_points or lower --network.k"
        )
    return method(network, OptimizerSettings(**settings.optimizer.as_dict()))


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
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    for message in (
        "isinstance.treespec, LeafSpec",
        "Checkpoint directory",
        ".*does not have many workers",
    ):
        warnings.filterwarnings("ignore", message=f".*{message}")


def make_trainer(
    settings: Settings, folder: Path, callbacks: list[Callback], arm: str, group: str
) -> L.Trainer:
    """A Trainer with our loggers and callbacks; a progress bar where somebody watches."""
    options = trainer_options(settings)
    if options.get("enable_progress_bar") is None:
        options["enable_progress_bar"] = sys.stderr.isatty()
    if options["enable_progress_bar"]:
        callbacks = [*callbacks, TQDMProgressBar(refresh_rate=5)]
    loggers: list[Logger] = [CSVLogger(folder, name="", version="csv")]
    mode = os.environ.get("WANDB_MODE", "offline")
    if mode != "disabled":
        loggers.append(_wandb(folder, arm, group, mode, settings))
    return L.Trainer(
        **options, logger=loggers, callbacks=callbacks, default_root_dir=folder,
        enable_model_summary=False,
    )  # fmt: skip


def trainer_options(settings: Settings) -> dict[str, Any]:
    """Keyword arguments of Lightning's Trainer."""
    return {k: v for k, v in settings.trainer.as_dict().items() if k != "enable_model_summary"}


def training_settings(settings: Settings) -> dict[str, Any]:
    """What decides how an arm is trained: everything but where the data lies and what is tested."""
    plain = report.plain(settings.as_dict())
    return plain | {
        "data": {k: v for k, v in plain["data"].items() if k not in ("root", "test_shapes")}
    }


def commit() -> str | None:
    """The commit of the code, "+" behind it when files have changed; None outside a checkout."""
    here = Path(__file__).parent

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", *words], cwd=here, capture_output=True, text=True, check=True
        ).stdout

    try:
        changed = git("status", "--porcelain", "--", here)
        return git("rev-parse", "--short=12", "HEAD").strip() + ("+" if changed.strip() else "")
    except (OSError, subprocess.CalledProcessError):
        return None


class Curve(Callback):
    """Collects what the paper's figures show: validation metrics against pairs seen."""

    def __init__(self, batch_size: int) -> None:
        self.batch_size = batch_size
        self.pairs, self.seconds = 0, 0.0
        self.points: list[dict[str, float]] = []
        self._losses: list[Tensor] = []
        self._since = 0.0

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Start the clock."""
        self._since = time.monotonic()

    def on_train_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: PairBatch,
        batch_idx: int,
    ) -> None:
        """Count."""
        self.pairs += len(batch)
        self._losses.append(outputs["loss"].detach())

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Add a point, and say it."""
        if trainer.sanity_checking or not self._losses:
            return
        self._tick()
        values = {
            k.removeprefix("val/"): float(v)
            for k, v in trainer.callback_metrics.items()
            if k.startswith("val/")
        }
        loss = float(torch.stack(self._losses).mean())
        self._losses.clear()
        shown = (
            "match_accuracy",
            "rotation_error_deg_mean",
            "rotation_error_deg_median",
            "relative_euler_rmse_deg",
            "translation_rmse",
        )
        self.points.append({"pairs_seen": self.pairs, "loss": loss} | {k: values[k] for k in shown})
        line = (
            f"step {trainer.global_step:6d}  {self.pairs:7,d} pairs  {self.seconds:5.0f} s  loss {loss:7.4f}  "
            f"matches {100 * values['match_accuracy']:5.1f} %  rotation {values['rotation_error_deg_mean']:7.2f} deg mean, "
            f"{values['rotation_error_deg_median']:6.2f} median"
        )
        bar = trainer.progress_bar_callback
        bar.print(line) if isinstance(bar, TQDMProgressBar) else say(line)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Stop the clock."""
        self._tick()

    def state_dict(self) -> dict[str, Any]:
        """Goes into checkpoints, so that a resumed run has its whole curve."""
        return {"pairs": self.pairs, "seconds": self.seconds, "points": self.points}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        self.pairs, self.seconds = state_dict["pairs"], state_dict["seconds"]
        self.points = state_dict["points"]

    def _tick(self) -> None:
        now = time.monotonic()
        self.seconds += now - self._since
        self._since = now


class SaveOnInterrupt(Callback):
    """Ctrl-C leaves a checkpoint and says how to go on."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        """Lightning calls this before it gives up."""
        if isinstance(exception, KeyboardInterrupt):
            trainer.save_checkpoint(self.path)
            say(
                f"interrupted at step {trainer.global_step}; saved {self.path}; the same command goes on from there"
            )


def say(text: str) -> None:
    """Print a line for the user."""
    print(text, flush=True)


def replace_text(path: Path, text: str) -> None:
    """Write a file so that nobody ever reads half of it."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text)
    partial.replace(path)


def _wandb(folder: Path, arm: str, group: str, mode: str, settings: Settings) -> WandbLogger:
    import wandb  # starts slowly, and not everybody wants it

    os.environ.setdefault("WANDB_SILENT", "true")  # else it talks before it reads its settings
    quiet = wandb.Settings(
        silent=True, console="off", disable_git=True, save_code=False, x_disable_stats=True
    )
    logger = WandbLogger(
        project="corrmat", name=f"{group}/{arm}", group=group, job_type=arm, save_dir=folder,
        offline=mode != "online", settings=quiet,
    )  # fmt: skip
    logger.log_hyperparams(report.plain(settings.as_dict()))
    return logger


def _trained_elsewhere(recipe: Recipe, arm: str, settings: Settings, runs: Path) -> Trained | None:
    """The same arm trained to the end, with the same settings, by the experiment named."""
    if recipe.networks_of is None:
        return None
    folder = runs / recipe.scale / recipe.data / recipe.networks_of / arm
    done, stored = folder / "trained.json", folder / "settings.yaml"
    if not done.is_file() or yaml.safe_load(stored.read_text()) != training_settings(settings):
        return None
    say(f"the network is the one that experiment {recipe.networks_of} trained: {folder}")
    content = json.loads(done.read_text())
    return Trained(**content | {"checkpoint": folder / content["checkpoint"]})


def _scores(tests: list[dict[str, Tensor]], bands_deg: tuple[float, ...]) -> dict[str, Any]:
    everything = {key: torch.cat([found[key] for found in tests]) for key in tests[0]}
    scores: dict[str, Any] = metrics.summary(everything)
    if bands_deg:
        scores["bands"] = [
            {"band_deg": [low, high]} | metrics.summary(found)
            for low, high, found in zip(bands_deg, bands_deg[1:], tests, strict=False)
        ]
    return scores


def _rows(arm: str, band: int, found: dict[str, Tensor]) -> list[dict[str, Any]]:
    """Lines of per_pair.csv: the predicted transform and what it scores."""
    columns = found["transform"].tolist()
    return [
        {
            "arm": arm,
            "band": band,
            "shape": int(found["shape"][i]),
            "category": int(found["category"][i]),
            "rotation_error_deg": f"{float(found['rotation_error_deg'][i]):.5g}",
            "translation_error": f"{float(found['translation_error'][i]):.5g}",
            "right": int(found["right"][i]) if found["right"][i].isfinite() else "",
            "rows": int(found["rows"][i]),
            "chamfer": f"{float(found['chamfer'][i]):.5g}",
            "transform": " ".join(f"{value:.6g}" for value in columns[i]),
        }
        for i in range(len(columns))
    ]


def _write(
    folder: Path, record: dict[str, Any], recipe: Recipe, rows: list[dict[str, Any]]
) -> None:
    """Write all files of a record beside its place, then move them in, metrics.json last."""
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    with (partial / "per_pair.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    settings = {arm: report.plain(s.as_dict()) for arm, s in recipe.settings.items()}
    for own in settings.values():
        own["data"].pop("root")  # where the data lies is nobody else's business
    (partial / "config.yaml").write_text(
        yaml.safe_dump({"id": recipe.id, "scale": recipe.scale, "arms": settings}, sort_keys=False)
    )
    report.curves_figure(record, partial / "curves.png")
    (partial / "metrics.json").write_text(json.dumps(record, indent=1) + "\n")
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("per_pair.csv", "config.yaml", "curves.png", "metrics.json"):
        (partial / name).replace(folder / name)
    partial.rmdir()
