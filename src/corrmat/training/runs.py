"""What lies under runs/: which arm is trained with which settings, and where to continue."""

import contextlib
import itertools
import json
import logging
import pickle
import shutil
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, cast

import torch
import yaml
from filelock import Timeout

from corrmat.errors import CorrmatError
from corrmat.files import folder_lock, replace_json, replace_text
from corrmat.reporting.record import COMMIT_SEPARATOR
from corrmat.training.hardware import is_first_process
from corrmat.training.preflight import Arm
from corrmat.training.recipe import Recipe, Settings, default_settings, merge
from corrmat.weights import checksum, load_model

log = logging.getLogger("corrmat")
_TRAINED = "trained.json"
_SETTINGS = "settings.yaml"
_COMMITS = "commits.txt"  # of the code, one for each time that the run was started or resumed
_UNIMPORTANT = {
    "data": ("root", "name", "num_workers", "test_shapes"),
    "trainer": ("enable_progress_bar", "log_every_n_steps"),
}
_RECORDED = "recorded"  # marks an arm whose record is written: the next run trains anew


@dataclass
class TrainedArm:
    """An arm after training."""

    checkpoint: Path  # the best weights on validation
    pairs_seen: int
    train_seconds: float
    commit: str | None
    curve: list[dict[str, float]] = field(default_factory=list)
    hardware: dict[str, object] = field(default_factory=dict)


def arm_folders(recipe: Recipe, arm: str, runs: Path) -> list[Path]:
    """List the folders of an arm: of this experiment, and of the one named by `networks_of`."""
    identities = filter(None, (recipe.id, recipe.networks_of))
    return [runs / recipe.place_of(identity) / arm for identity in identities]


@contextlib.contextmanager
def only_process(folder: Path) -> Iterator[None]:
    """Keep other trainings out of a folder; the processes of one distributed training share it.

    Raises:
        CorrmatError: another training writes to it.
    """
    if not is_first_process():
        yield
        return
    try:
        with folder_lock(folder).acquire(timeout=0):
            yield
    except Timeout as error:
        raise CorrmatError(
            f"another process trains into {folder}; wait for it, or name another folder: --runs"
        ) from error


def training_settings(arm: Arm) -> str:
    """Return what decides how an arm is trained, as YAML.

    Settings, and checksums of the shapes and of the weights that it starts from. What only says
    where the data lies, and what is shown meanwhile, does not count.
    """
    settings = _that_count(arm.settings.as_plain())
    checksums: Settings = {"data": {"checksum": arm.datamodule.clouds("train").checksum()}}
    if arm.settings.start is not None:
        checksums["start_checksum"] = checksum(load_model(arm.settings.start))
    return yaml.safe_dump(merge(settings, checksums), sort_keys=False)


def _that_count(settings: Settings) -> Settings:
    """Leave out the settings that do not decide how an arm is trained."""
    kept: Settings = {}
    for group, unimportant in _UNIMPORTANT.items():
        values = cast(Settings, settings[group])
        kept[group] = {name: value for name, value in values.items() if name not in unimportant}
    return settings | kept


def set_aside(folder: Path, arm: Arm) -> None:
    """Make room for a run: keep one that a record was written of, or of other settings."""
    recorded = (folder / _RECORDED).exists()
    if not any(folder.glob("*.ckpt")) or (_same_settings(folder, arm) and not recorded):
        shutil.rmtree(folder, ignore_errors=True)
        return
    kept = next(place for place in _places_to_keep(folder) if _may_replace(folder, place))
    shutil.rmtree(kept, ignore_errors=True)
    folder.rename(kept)
    log.info(f"the earlier run is kept: {kept}")


def _places_to_keep(folder: Path) -> Iterator[Path]:
    """List where a run may be set aside: arm.previous, arm.previous2, ..."""
    yield folder.with_name(f"{folder.name}.previous")
    for number in itertools.count(2):
        yield folder.with_name(f"{folder.name}.previous{number}")


def _may_replace(folder: Path, kept: Path) -> bool:
    """Tell whether a run may be put in the place of an earlier one that was set aside.

    Both must be finished, of the same settings, and the new one have a record if the old one has.
    """
    if not kept.exists():
        return True
    if not all((each / _TRAINED).is_file() for each in (folder, kept)):
        return False
    same = (folder / _SETTINGS).read_text() == (kept / _SETTINGS).read_text()
    return same and ((folder / _RECORDED).exists() or not (kept / _RECORDED).exists())


def start_run(folder: Path, arm: Arm, commit: str | None) -> None:
    """Create a run's folder, or go on in it: write its settings and add the code's commit."""
    folder.mkdir(parents=True, exist_ok=True)
    replace_text(folder / _SETTINGS, training_settings(arm))
    commits = [*_commits(folder), *([commit] if commit else [])]
    replace_text(folder / _COMMITS, "".join(f"{each}\n" for each in dict.fromkeys(commits)))


def commits_of(folder: Path) -> str | None:
    """Return the commits of the code that trained a run, e.g. "9d7c4941ea0b / a0ddfb6c5d12"."""
    return COMMIT_SEPARATOR.join(_commits(folder)) or None


def _commits(folder: Path) -> list[str]:
    file = folder / _COMMITS
    return file.read_text().splitlines() if file.is_file() else []


def finish_run(folder: Path, trained: TrainedArm) -> None:
    """Note that an arm is trained."""
    content = asdict(trained) | {"checkpoint": trained.checkpoint.name}
    replace_json(folder / _TRAINED, content)


def trained_facts(folder: Path) -> dict[str, Any]:
    """Return what a finished run says of itself: pairs_seen, train_seconds, commit and curve."""
    content = json.loads((folder / _TRAINED).read_text())
    return {name: content[name] for name in ("pairs_seen", "train_seconds", "commit", "curve")}


def mark_recorded(folder: Path) -> None:
    """Note that the record of an arm is written."""
    if folder.is_dir():
        (folder / _RECORDED).touch()


def find_trained(recipe: Recipe, arm: Arm, runs: Path) -> TrainedArm | None:
    """Find the same arm, trained to the end with the same settings before.

    Either this experiment trained it and has not written its record yet, or the experiment did
    that `networks_of` names.
    """
    main, *others = arm_folders(recipe, arm.name, runs)
    for folder in (*([] if (main / _RECORDED).exists() else [main]), *others):
        if (folder / _TRAINED).is_file() and _same_settings(folder, arm):
            content = json.loads((folder / _TRAINED).read_text())
            checkpoint = folder / content["checkpoint"]
            if checkpoint.is_file():
                return TrainedArm(**content | {"checkpoint": checkpoint})
    return None


def find_interrupted(folder: Path, arm: Arm) -> Path | None:
    """Find the checkpoint of an interrupted run of the same settings.

    It is the last one, or the best one if the last was cut short.
    """
    if (folder / _TRAINED).is_file() or not _same_settings(folder, arm):
        return None
    for checkpoint in (folder / "last.ckpt", folder / "best.ckpt"):
        if checkpoint.is_file():
            try:
                torch.load(checkpoint, map_location="cpu", weights_only=True, mmap=True)
            except (RuntimeError, OSError, ValueError, EOFError, pickle.UnpicklingError):
                log.info(f"{checkpoint} cannot be read and is left out")
            else:
                return checkpoint
    return None


def best_checkpoint(recipe: Recipe, arm: Arm, runs: Path) -> Path:
    """Find the best weights of an arm: its own, or the same arm's of `networks_of`."""
    main, *others = arm_folders(recipe, arm.name, runs)
    for folder in (main, *others):
        if (folder / "best.ckpt").is_file() and (folder == main or _same_settings(folder, arm)):
            return folder / "best.ckpt"
    return main / "best.ckpt"


def recorded_checkpoint(recipe: Recipe, arm: Arm, runs: Path) -> Path | None:
    """Find the weights that the record of an arm was tested with; None if they are gone."""
    folder = runs / recipe.place / arm.name
    checkpoint = folder / "best.ckpt"
    recorded = (folder / _RECORDED).exists() and _same_settings(folder, arm)
    return checkpoint if recorded and checkpoint.is_file() else None


def _same_settings(folder: Path, arm: Arm) -> bool:
    """Tell whether a run had an arm's settings; options newer than the run had their defaults."""
    stored = folder / _SETTINGS
    if not stored.is_file():
        return False
    defaults = default_settings(arm.settings.method)
    then = _that_count(merge(defaults, yaml.safe_load(stored.read_text())))
    return then == yaml.safe_load(training_settings(arm))
