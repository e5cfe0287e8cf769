"""A recipe is YAML: what an experiment claims, and the settings of its arms at every scale.

Its layers lie over each other: the family's file (`base`), its scale, the experiment's file, its
scale, the arm's own lines, the command line. The result is checked against the types of the
classes that it configures, so a misspelt key is an error and nothing starts.
"""

import inspect
import typing
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, cast

import docstring_parser
import lightning as L
import yaml
from jsonargparse import ArgumentParser, Namespace

from corrmat.baselines import BASELINES, UNTRAINED
from corrmat.data.datamodule import RegistrationDataModule, data_name
from corrmat.errors import CorrmatError, short_message
from corrmat.methods import METHODS
from corrmat.module import OptimizerSettings
from corrmat.reporting.record import ArmResult, place_of

SCALES = ("smoke", "laptop", "overnight", "paper")
GROUPS = ("data", "network", "loss", "optimizer", "trainer")
Precision = Literal["auto", "32-true", "64-true", "bf16-mixed", "bf16-true", "16-mixed"]
Settings = dict[str, object]
"""Nested settings as YAML has them."""

_KEYS = {
    "id", "title", "family", "baseline", "treatment", "controls", "paper", "arms", "scales",
    "bands_deg", "sweep_outliers", "networks_of", "baselines", "test_pairs", "base", "seed",
    "start", *GROUPS,
}  # fmt: skip
_NOT_TRAINER: set[str | int] = {  # set by this project
    "enable_checkpointing", "enable_model_summary", "logger", "callbacks", "default_root_dir",
    "plugins", "profiler", "model_registry", "use_distributed_sampler", "precision",
}  # fmt: skip
# Options of the data that do not change its test pairs, or that a digest is found by.
_NOT_TEST_PAIRS = {
    "data", "categories", "root", "name", "batch_size", "num_workers", "train_shapes", "stretch",
    "new_shapes",
}  # fmt: skip


@dataclass(frozen=True)
class ArmSettings:
    """Every setting of an arm, with the types of the classes that it configures."""

    name: str
    method: str
    seed: int
    data: Namespace  # of RegistrationDataModule
    network: Namespace  # of the method's network
    loss: Namespace  # of the method's LossSettings
    optimizer: OptimizerSettings
    trainer: Namespace  # of Lightning's Trainer; `precision` may be "auto"
    start: str | None = None  # weights to start from, as `load_model` takes them

    @property
    def data_name(self) -> str:
        """What the data set is called in results/."""
        return data_name(self.data.data, self.data.root, self.data.name)

    def as_plain(self) -> Settings:
        """Return the settings as dictionaries, lists, numbers and text, as YAML has them."""
        groups = {name: getattr(self, name) for name in GROUPS}
        groups["optimizer"] = asdict(self.optimizer)
        start = {"start": self.start} if self.start else {}
        return cast(Settings, _plain({"method": self.method, "seed": self.seed, **start, **groups}))


@dataclass(frozen=True)
class Recipe:
    """One experiment at one scale."""

    id: str
    title: str
    scale: str
    family: str  # DCP, RPMNet, PCRNet, or the name of a network of one's own
    baseline: str | None  # the arm METHOD
    treatment: str  # the arm METHOD_corr
    controls: tuple[str, ...]  # further arms
    paper: dict[str, ArmResult]  # what the paper reports, by arm
    arms: dict[str, ArmSettings]
    bands_deg: tuple[float, ...]  # edges of rotation bands to test on one by one; may be empty
    sweep_outliers: tuple[float, ...]  # shares of outliers to test on as well; may be empty
    networks_of: str | None  # the experiment whose trained networks serve here too
    baselines: tuple[str, ...]  # predictors to test that need no training
    test_pairs: str | None  # expected digest of the frozen test pairs, if there is one

    @property
    def data(self) -> str:
        """What the data set is called in results/."""
        return next(iter(self.arms.values())).data_name

    @property
    def test_changes(self) -> list[dict[str, float]]:
        """How the test pairs of each rotation band differ from those of training.

        Between two edges the angles lie, and there is no translation (tables 1 and 2 of the paper).
        Without bands there is one set of pairs, as in training.
        """
        return [
            {"min_rotation_deg": low, "rotation_deg": high, "translation": 0.0}
            for low, high in zip(self.bands_deg, self.bands_deg[1:], strict=False)
        ] or [{}]

    @property
    def place(self) -> Path:
        """Folder of the record below results/, and of the runs below runs/."""
        return self.place_of(self.id)

    def place_of(self, identity: str) -> Path:
        """Return the folder of another experiment of the same scale, data and seed."""
        return place_of(self.scale, self.data, identity, next(iter(self.arms.values())).seed)


def load(
    path: Path,
    scale: str,
    overrides: Mapping[str, object] | None = None,
    arms: Sequence[str] | None = None,
) -> Recipe:
    """Read a recipe and put overrides over it.

    Args:
        path: the experiment's YAML file.
        scale: one of `SCALES`.
        overrides: nested settings, e.g. {"data": {"num_points": 256}}.
        arms: only these arms.

    Raises:
        CorrmatError: the file, a key, a value or an override is not valid.
    """
    merged = _merge_layers(path, scale)
    _check_keys(merged, path)
    scales = cast(Settings, merged.get("scales") or {})
    if scales and scale not in (*scales, "laptop"):  # whose settings may be those without a scale
        raise CorrmatError(f"{path} has no scale {scale}, but {', '.join(scales)}")
    all_arms = cast(dict[str, Settings | None], merged["arms"])
    for arm in arms or ():
        if arm not in all_arms:
            raise CorrmatError(f"{path}: unknown arm {arm!r}; arms: {', '.join(all_arms)}")
    common = {key: merged[key] for key in ("seed", "start", *GROUPS) if key in merged}
    layers = {arm: dict(all_arms[arm] or {}) for arm in arms or all_arms}
    methods = [str(layer.get("method", arm)) for arm, layer in layers.items()]
    settings = {
        arm: _arm_settings(
            arm, common, layer, _overrides_of(method, methods, overrides or {}), path
        )
        for (arm, layer), method in zip(layers.items(), methods, strict=True)
    }
    return Recipe(
        id=str(merged["id"]),
        title=str(merged["title"]),
        scale=scale,
        paper={
            arm: ArmResult.from_json(values)
            for arm, values in cast(dict[str, Settings], merged.get("paper") or {}).items()
        },
        arms=settings,
        bands_deg=tuple(cast(list[float], merged.get("bands_deg") or ())),
        sweep_outliers=tuple(cast(list[float], merged.get("sweep_outliers") or ())),
        networks_of=str(merged["networks_of"]) if merged.get("networks_of") else None,
        baselines=_check_baselines(cast(list[str], merged.get("baselines") or []), path),
        test_pairs=_expected_digest(merged, scale, settings, overrides or {}),
        **_roles(merged, all_arms, settings, path),  # pyright: ignore[reportArgumentType]
    )


def add_settings(parser: ArgumentParser, methods: Sequence[str] | None = None) -> None:
    """Add the typed settings of arms as options: --seed, --data.*, --network.* and so on.

    Args:
        parser: to add to.
        methods: the options of these methods' networks and losses; of all by default.
    """
    classes = [METHODS[name] for name in (METHODS if methods is None else methods)]
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of weights, pairs and held-out shapes"
    )
    parser.add_argument(
        "--start", type=str | None, default=None,
        help="weights to start from, as --model of corrmat register takes them",
    )  # fmt: skip
    parser.add_class_arguments(RegistrationDataModule, "data", skip={"seed"})
    _add_union(parser, "network", [method.network_type for method in classes])
    _add_union(parser, "loss", [method.LossSettings for method in classes])
    parser.add_class_arguments(OptimizerSettings, "optimizer")
    parser.add_class_arguments(L.Trainer, "trainer", skip=_NOT_TRAINER, instantiate=False)
    parser.add_argument(
        "--trainer.precision", type=Precision, default="auto",
        help="auto: bfloat16 products where the machine computes them fast, else float32",
    )  # fmt: skip


def merge(under: Mapping[str, object], over: Mapping[str, object]) -> Settings:
    """Merge dictionaries key by key; other values are replaced."""
    merged = dict(under)
    for key, value in over.items():
        below = merged.get(key)
        if isinstance(value, Mapping) and isinstance(below, Mapping):
            merged[key] = merge(below, value)
        else:
            merged[key] = value
    return merged


def _add_union(parser: ArgumentParser, group: str, classes: Sequence[type]) -> None:
    """Add the parameters of several classes as one group; the first class that has one wins."""
    first, *others = sorted(set(classes), key=lambda c: (-len(_parameters(c)), c.__name__))
    added = set(_parameters(first))
    parser.add_class_arguments(first, group, instantiate=False)
    for other in others:
        hints = typing.get_type_hints(other.__init__)
        documented = docstring_parser.parse(other.__doc__ or "").params
        described = {parameter.arg_name: parameter.description for parameter in documented}
        for name, parameter in _parameters(other).items():
            if name not in added:
                parser.add_argument(
                    f"--{group}.{name}", type=hints.get(name, Any), default=parameter.default,
                    help=f"of {other.__name__}: {described.get(name, '')}",
                )  # fmt: skip
                added.add(name)


def _parameters(cls: type) -> dict[str, inspect.Parameter]:
    parameters = inspect.signature(cls).parameters
    kinds = inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY
    return {name: p for name, p in parameters.items() if p.kind in kinds}


def _merge_layers(path: Path, scale: str, above: tuple[Path, ...] = ()) -> Settings:
    """Read a recipe and lay it over its base, and each one's scale over itself.

    An experiment's name, what the paper reports of it and which test pairs it has are its own.
    """
    recipe = _read(path)
    merged: Settings = {}
    if "base" in recipe:
        base = path.parent / str(recipe["base"])
        above = (*above, path.resolve())
        if base.resolve() in above:
            raise CorrmatError(f"{path}: its base {base} is based on it")
        merged = _merge_layers(base, scale, above)
        merged = {k: v for k, v in merged.items() if k not in ("id", "paper", "test_pairs")}
    for layer in (recipe, _at_scale(recipe, scale)):
        merged = merge(merged, layer)
    return merged


def _check_keys(merged: Settings, path: Path) -> None:
    """Check the keys of a merged recipe and the types of those that are not settings."""
    unknown = sorted(set(merged) - _KEYS)
    if unknown:
        raise CorrmatError(f"{path}: unknown key {unknown[0]!r}; keys: {', '.join(sorted(_KEYS))}")
    for key in ("id", "title", "arms"):
        if key not in merged:
            raise CorrmatError(f"{path} lacks {key!r}")
    arms = merged["arms"]
    if not isinstance(arms, dict) or not all(_is_mapping(settings) for settings in arms.values()):
        raise CorrmatError(f"{path}: arms must be names with settings, e.g. arms: {{DCP: {{}}}}")
    for key in ("bands_deg", "sweep_outliers", "baselines", "controls"):
        if not isinstance(merged.get(key) or [], list):
            raise CorrmatError(f"{path}: {key} must be a list, e.g. {key}: [...]")
    for key in ("bands_deg", "sweep_outliers"):
        values = cast(list[object], merged.get(key) or [])
        if not all(isinstance(value, int | float) for value in values):
            raise CorrmatError(f"{path}: {key} must be a list of numbers, not {values}")
    edges = cast(list[float], merged.get("bands_deg") or [])
    if len(edges) == 1 or edges != sorted(set(edges)):
        raise CorrmatError(f"{path}: bands_deg must be two or more rising numbers, not {edges}")
    for key in ("paper", "test_pairs"):
        if not isinstance(merged.get(key) or {}, dict):
            raise CorrmatError(f"{path}: {key} must be a mapping, e.g. {key}: {{...}}")


def _roles(
    merged: Settings, arms: Mapping[str, object], chosen: Mapping[str, object], path: Path
) -> Settings:
    """Read which of the chosen arms is METHOD, which METHOD_corr, and which are controls.

    A recipe of one arm need not say it.
    """
    treatment = merged.get("treatment") or (next(iter(arms)) if len(arms) == 1 else None)
    baseline = merged.get("baseline")
    controls = tuple(cast(list[str], merged.get("controls") or ()))
    if treatment is None:
        raise CorrmatError(f"{path} lacks 'treatment': the arm that the experiment is about")
    named = [arm for arm in (baseline, treatment, *controls) if arm is not None]
    if sorted(map(str, named)) != sorted(arms):
        raise CorrmatError(
            f"{path}: baseline, treatment and controls name {', '.join(map(str, named))}; "
            f"the arms are {', '.join(arms)}; further arms belong under controls: [...]"
        )
    return {
        "family": str(merged.get("family") or treatment),
        "baseline": baseline if baseline in chosen else None,
        "treatment": treatment if treatment in chosen else next(iter(chosen)),
        "controls": tuple(arm for arm in controls if arm in chosen),
    }


def _overrides_of(
    method: str, methods: Sequence[str], overrides: Mapping[str, object]
) -> Mapping[str, object]:
    """Leave out the options of networks and losses that only other arms' methods have."""

    def has(name: str, group: str, option: str) -> bool:
        classes = METHODS.get(name)
        kind = classes and {"network": classes.network_type, "loss": classes.LossSettings}[group]
        return kind is not None and option in _parameters(kind)

    kept = dict(overrides)
    for group in ("network", "loss"):
        options = overrides.get(group)
        if isinstance(options, Mapping):
            kept[group] = {
                option: value
                for option, value in options.items()
                if has(method, group, option) or not any(has(m, group, option) for m in methods)
            }
    return kept


def _arm_settings(
    arm: str,
    common: Mapping[str, object],
    arm_layer: Settings,
    overrides: Mapping[str, object],
    path: Path,
) -> ArmSettings:
    """Check the settings of an arm against the types of what they configure."""
    method = str(arm_layer.pop("method", arm))
    if method not in METHODS:
        raise CorrmatError(f"{path}: unknown method {method!r}; methods: {', '.join(METHODS)}")
    settings = merge(common, arm_layer)
    trainer = overrides.get("trainer")
    if isinstance(trainer, Mapping) and trainer.get("max_epochs") is not None:
        # Whoever names a number of epochs means it: the recipe's steps no longer count.
        settings = merge(settings, {"trainer": {"max_steps": -1}})
    parser = ArgumentParser(prog="corrmat", exit_on_error=False)
    add_settings(parser, [method])
    try:
        parser.parse_object(settings)
    except Exception as error:  # jsonargparse raises errors of several types
        raise CorrmatError(f"{path}: {short_message(error)}") from error
    try:
        parsed = parser.parse_object(merge(settings, overrides))
    except Exception as error:
        raise CorrmatError(
            f"{short_message(error)} (corrmat fit --help lists the options)"
        ) from error
    return ArmSettings(
        arm, method, parsed.seed, parsed.data, parsed.network,
        parsed.get("loss") or Namespace(), OptimizerSettings(**parsed.optimizer.as_dict()),
        parsed.trainer, parsed.start,
    )  # fmt: skip


def default_settings(method: str) -> Settings:
    """Return the settings of an arm of which a recipe says nothing but the method."""
    return _arm_settings(method, {}, {}, {}, Path("defaults")).as_plain()


def _check_baselines(names: Sequence[str], path: Path) -> tuple[str, ...]:
    """Check the names of baselines."""
    available = (*BASELINES, UNTRAINED)
    for name in names:
        if name not in available:
            raise CorrmatError(
                f"{path}: unknown baseline {name!r}; baselines: {', '.join(available)}"
            )
    return tuple(names)


def _expected_digest(
    merged: Settings,
    scale: str,
    arms: Mapping[str, ArmSettings],
    overrides: Mapping[str, object],
) -> str | None:
    """Return the recipe's digest, unless an override asks for other test pairs."""
    changed = set(cast(Mapping[str, object], overrides.get("data") or {})) - _NOT_TEST_PAIRS
    if changed or "seed" in overrides:
        return None
    by_scale = cast(Mapping[str, Mapping[str, str]], merged.get("test_pairs") or {})
    data = next(iter(arms.values())).data
    categories = f"[{','.join(sorted(data.categories))}]" if data.categories else ""
    return (by_scale.get(scale) or {}).get(data.data + categories)


def _at_scale(recipe: Settings, scale: str) -> Settings:
    """Return the part of a recipe for a scale."""
    scales = recipe.get("scales") or {}
    if not isinstance(scales, dict) or not all(_is_mapping(part) for part in scales.values()):
        raise CorrmatError("scales must be names with settings, e.g. scales: {laptop: {}}")
    for name in scales:
        if name not in SCALES:
            raise CorrmatError(f"unknown scale {name!r}; scales: {', '.join(SCALES)}")
    return scales.get(scale) or {}


def _is_mapping(value: object) -> bool:
    return value is None or isinstance(value, dict)


def _read(path: Path) -> Settings:
    """Read a YAML file that holds a dictionary."""
    if not path.is_file():
        raise CorrmatError(f"no recipe {path}; see configs/exp/")
    try:
        content = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise CorrmatError(f"{path} is not YAML: {short_message(error)}") from error
    if not isinstance(content, dict):
        raise CorrmatError(f"{path} holds no settings")
    return content


def _plain(value: object) -> object:
    """Convert nested settings to dictionaries, lists, numbers and text."""
    if isinstance(value, Namespace):
        value = value.as_dict()
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value if isinstance(value, str | int | float | bool | None) else str(value)
