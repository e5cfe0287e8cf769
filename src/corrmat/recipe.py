"""A recipe is YAML: what an experiment claims, and the settings of its arms at every scale.

Layers, each over the one before: the family's file (`base`), its scale, the experiment's
file, its scale, the arm's own lines, the command line. The sum is checked against the types
of the classes that it configures, so a misspelt key is an error and nothing starts.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning as L
import yaml
from jsonargparse import ArgumentParser, Namespace

from corrmat.baselines import BASELINES, UNTRAINED
from corrmat.data.datamodule import RegistrationDataModule
from corrmat.errors import CorrmatError
from corrmat.methods import METHODS
from corrmat.module import OptimizerSettings

SCALES = ("smoke", "laptop", "paper")
GROUPS = ("data", "network", "optimizer", "trainer")
_TOP = {
    "id",
    "title",
    "paper",
    "arms",
    "scales",
    "bands_deg",
    "sweep_outliers",
    "networks_of",
    "baselines",
    "test_pairs",
    "base",
    "seed",
    *GROUPS,
}
_NOT_TRAINER: set[str | int] = {  # ours to decide
    "enable_checkpointing",
    "enable_model_summary",
    "logger",
    "callbacks",
    "default_root_dir",
    "plugins",
    "profiler",
    "model_registry",
    "use_distributed_sampler",
}

_NOT_TEST_PAIRS = {  # options of the data that leave them alone
    "--data.data",
    "--data.root",
    "--data.batch_size",
    "--data.num_workers",
    "--data.train_shapes",
    "--data.stretch",
}


@dataclass(frozen=True)
class Recipe:
    """One experiment at one scale."""

    id: str
    title: str
    scale: str
    paper: dict[str, Any]  # arm -> what the paper reports, by our metrics' names
    settings: dict[str, Namespace]  # arm -> seed, data, network, optimizer, trainer
    bands_deg: tuple[float, ...]  # edges of rotation bands to test on one by one; may be empty
    sweep_outliers: tuple[float, ...]  # shares of outliers to test on besides; may be empty
    networks_of: str | None  # the experiment whose trained networks serve here too
    baselines: tuple[str, ...]  # what else is tested: names of `baselines`
    test_pairs: str | None  # checksum that the frozen pairs must have; None: not known

    @property
    def data(self) -> str:
        """Which data set: "shapes" or "modelnet40"."""
        return next(iter(self.settings.values())).data.data


def load(path: Path, scale: str, options: list[str], arms: list[str] | None = None) -> Recipe:
    """Read a recipe and put command-line options over it.

    Args:
        path: the experiment's YAML file.
        scale: one of `SCALES`.
        options: typed overrides, e.g. ["--data.num_points", "256"].
        arms: only these arms.

    Raises:
        CorrmatError: the file, a key, a value or an option is not as it should be.
    """
    experiment = _read(path)
    base = _read(path.parent / experiment["base"]) if "base" in experiment else {}
    layers = [base, _scale(base, scale), experiment, _scale(experiment, scale)]
    merged: dict[str, Any] = {}
    for layer in layers:
        merged = merge(merged, layer)
    unknown = sorted(set(merged) - _TOP)
    if unknown:
        raise CorrmatError(f"{path}: unknown key {unknown[0]!r}; known: {', '.join(sorted(_TOP))}")
    for key in ("id", "title", "arms"):
        if key not in merged:
            raise CorrmatError(f"{path} lacks {key!r}")
    arms_known = merged["arms"]
    if not isinstance(arms_known, dict) or not all(_is_mapping(own) for own in arms_known.values()):
        raise CorrmatError(f"{path}: arms must be names with settings, e.g. arms: {{DCP: {{}}}}")
    for key in ("bands_deg", "sweep_outliers", "baselines"):
        if not isinstance(merged.get(key) or [], list):
            raise CorrmatError(f"{path}: {key} must be a list, e.g. {key}: [...]")
    chosen = merged["arms"] if arms is None else {a: merged["arms"].get(a) for a in arms}
    settings = {}
    for arm, own in chosen.items():
        if arm not in merged["arms"]:
            raise CorrmatError(f"{path}: unknown arm {arm!r}; known: {', '.join(merged['arms'])}")
        own = dict(own or {})
        method = own.pop("method", arm)
        if method not in METHODS:
            raise CorrmatError(f"{path}: unknown method {method!r}; known: {', '.join(METHODS)}")
        common = {key: merged[key] for key in ("seed", *GROUPS) if key in merged}
        settings[arm] = _parse(method, merge(common, own), options, path)
    return Recipe(
        id=str(merged["id"]),
        title=merged["title"],
        scale=scale,
        paper=merged.get("paper") or {},
        settings=settings,
        bands_deg=tuple(merged.get("bands_deg") or ()),
        sweep_outliers=tuple(merged.get("sweep_outliers") or ()),
        networks_of=str(merged["networks_of"]) if "networks_of" in merged else None,
        baselines=_known_baselines(merged.get("baselines") or (), path),
        test_pairs=_checksum(merged, scale, settings, options),
    )


def parser(method: str, prog: str = "corrmat") -> ArgumentParser:
    """The typed settings of one method as command-line options."""
    found = ArgumentParser(prog=prog, exit_on_error=False, add_help=False)
    found.add_argument("--seed", type=int, default=0, help="of weights, pairs and held-out shapes")
    found.add_class_arguments(RegistrationDataModule, "data", skip={"seed"})
    found.add_class_arguments(METHODS[method].network_type, "network")
    found.add_class_arguments(OptimizerSettings, "optimizer")
    found.add_class_arguments(L.Trainer, "trainer", skip=_NOT_TRAINER, instantiate=False)
    return found


def merge(under: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """Dictionaries merged key by key; everything else is replaced."""
    merged = dict(under)
    for key, value in over.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = merge(merged[key], value) if both else value
    return merged


def _parse(method: str, settings: dict[str, Any], options: list[str], path: Path) -> Namespace:
    typed = parser(method)
    if any(option.startswith("--trainer.max_epochs") for option in options):
        # Whoever says how many epochs means it: the recipe's steps no longer count.
        settings = merge(settings, {"trainer": {"max_steps": -1}})
    # Both error types are jsonargparse's; either way the first line says what is wrong.
    try:
        under = typed.parse_object(settings)
    except Exception as error:
        raise CorrmatError(f"{path}: {_first_line(error)}") from error
    try:
        found = typed.parse_args(options, namespace=under)
    except Exception as error:
        raise CorrmatError(
            f"{_first_line(error)} (corrmat fit --help lists the options)"
        ) from error
    return Namespace(method=method, **{name: found[name] for name in ("seed", *GROUPS)})


def _known_baselines(names: Sequence[str], path: Path) -> tuple[str, ...]:
    known = (*BASELINES, UNTRAINED)
    for name in names:
        if name not in known:
            raise CorrmatError(f"{path}: unknown baseline {name!r}; known: {', '.join(known)}")
    return tuple(names)


def _checksum(
    merged: dict[str, Any], scale: str, settings: dict[str, Namespace], options: Sequence[str]
) -> str | None:
    """The recipe's checksum, unless an option asks for other test pairs or another data set."""
    names = {option.split("=")[0] for option in options} - _NOT_TEST_PAIRS
    other = any(name == "--seed" or name.startswith("--data.") for name in names)
    if other or any(arm.data.data != "shapes" for arm in settings.values()):
        return None
    return merged.get("test_pairs", {}).get(scale)


def _first_line(error: Exception) -> str:
    lines = [line.strip(" -") for line in str(error).splitlines() if line.strip(" -")]
    return " ".join(lines[:2])


def _scale(recipe: dict[str, Any], scale: str) -> dict[str, Any]:
    scales = recipe.get("scales") or {}
    if not isinstance(scales, dict) or not all(_is_mapping(own) for own in scales.values()):
        raise CorrmatError("scales must be names with settings, e.g. scales: {laptop: {}}")
    for name in scales:
        if name not in SCALES:
            raise CorrmatError(f"unknown scale {name!r}; known: {', '.join(SCALES)}")
    return scales.get(scale) or {}


def _is_mapping(value: object) -> bool:
    return value is None or isinstance(value, dict)


def _read(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise CorrmatError(f"no recipe {path}; see configs/exp/")
    try:
        content = yaml.safe_load(path.read_text())
    except yaml.YAMLError as error:
        raise CorrmatError(f"{path} is not YAML: {_first_line(error)}") from error
    if not isinstance(content, dict):
        raise CorrmatError(f"{path} holds no settings")
    return content
