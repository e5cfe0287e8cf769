"""The record of an experiment: what was measured, as typed data."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import cast

from corrmat.errors import CorrmatError
from corrmat.reporting.snapshots import PairSnapshot

Metrics = dict[str, float]
"""Metric name to value; NaN where a metric is undefined (null in JSON)."""
Json = Mapping[str, "object"]


@dataclass(frozen=True)
class Subset:
    """Metrics on one part of the test: a rotation band, or a share of outliers."""

    metrics: Metrics
    band_deg: tuple[float, float] | None = None
    outliers: float | None = None

    @property
    def label(self) -> str:
        """The subset's name in a table."""
        if self.band_deg is not None:
            return "{:g} to {:g} deg".format(*self.band_deg)
        return f"{100 * (self.outliers or 0):g} % outliers"

    @property
    def position(self) -> float:
        """The subset's place on a figure's axis: degrees, or per cent."""
        return sum(self.band_deg) / 2 if self.band_deg else 100 * (self.outliers or 0)

    def to_json(self) -> dict[str, object]:
        """Return the dictionary of metrics.json."""
        content: dict[str, object] = dict(self.metrics)
        if self.band_deg:
            return {"band_deg": self.band_deg} | content
        return {"outliers": self.outliers} | content

    @staticmethod
    def from_json(content: Json) -> "Subset":
        """Read the dictionary of metrics.json."""
        band = content.get("band_deg")
        low, high = cast(Sequence[float], band) if band else (0.0, 0.0)
        return Subset(
            _metrics(content, skip=("band_deg", "outliers")),
            (low, high) if band else None,
            cast("float | None", content.get("outliers")),
        )


@dataclass(frozen=True)
class ArmResult:
    """What an arm, a baseline or the paper's arm achieved."""

    metrics: Metrics  # over all test pairs
    bands: list[Subset] = field(default_factory=list)
    sweep: list[Subset] = field(default_factory=list)
    pairs_seen: int = 0  # training pairs; 0 for baselines and the paper
    train_seconds: float = 0.0
    trained_at: str | None = None  # commit of the code
    curve: list[Metrics] = field(default_factory=list)  # one point a validation

    _TRAINING = ("pairs_seen", "train_seconds", "trained_at", "curve")

    def get(self, name: str) -> float | None:
        """Return a metric; None where it is missing or undefined."""
        return defined(self.metrics.get(name))

    def overall(self, name: str) -> float | None:
        """Return a metric, or its mean over bands (of equal size) if only bands are given."""
        value = self.get(name)
        if value is not None or not self.bands:
            return value
        parts = [defined(band.metrics.get(name)) for band in self.bands]
        values = [part for part in parts if part is not None]
        return sum(values) / len(values) if len(values) == len(parts) else None

    def to_json(self) -> dict[str, object]:
        """Return the dictionary of metrics.json."""
        content: dict[str, object] = dict(self.metrics)
        if self.bands:
            content["bands"] = [band.to_json() for band in self.bands]
        if self.sweep:
            content["sweep"] = [subset.to_json() for subset in self.sweep]
        if self.curve or self.pairs_seen:
            content |= {name: getattr(self, name) for name in self._TRAINING}
        return content

    @staticmethod
    def from_json(content: Json) -> "ArmResult":
        """Read the dictionary of metrics.json, or of a recipe's `paper:` group."""
        bands = cast(Sequence[Json], content.get("bands") or ())
        sweep = cast(Sequence[Json], content.get("sweep") or ())
        curve = cast(Sequence[Json], content.get("curve") or ())
        return ArmResult(
            _metrics(content, skip=("bands", "sweep", *ArmResult._TRAINING)),
            [Subset.from_json(band) for band in bands],
            [Subset.from_json(subset) for subset in sweep],
            int(cast(float, content.get("pairs_seen") or 0)),
            float(cast(float, content.get("train_seconds") or 0)),
            cast("str | None", content.get("trained_at")),
            [_metrics(point) for point in curve],
        )


@dataclass(frozen=True)
class Record:
    """An experiment at one scale on one data set."""

    id: str
    title: str
    scale: str
    data: str
    family: str  # DCP, RPMNet, PCRNet, or the name of a network of one's own
    baseline: str | None  # the arm trained on the method's original loss (METHOD)
    treatment: str  # the arm trained on the correspondence matrix (METHOD_corr)
    controls: list[str]  # further arms
    seed: int
    commit: str | None
    hardware: dict[str, object]
    versions: dict[str, str]
    test_pairs: str
    bands_deg: list[float]
    arms: dict[str, ArmResult]
    baselines: dict[str, ArmResult]
    paper: dict[str, ArmResult]

    @property
    def place(self) -> Path:
        """Folder of the record below results/, and of its runs below runs/."""
        return place_of(self.scale, self.data, self.id, self.seed)

    @property
    def trained_on(self) -> str:
        """Scale, data set, and the seed unless it is 0: they tell an experiment's records apart."""
        seed = f", seed {self.seed}" if self.seed else ""
        return f"{self.scale}, {self.data}{seed}"

    @property
    def compared(self) -> list[str]:
        """The arms METHOD and METHOD_corr, as far as there are any."""
        return [arm for arm in (self.baseline, self.treatment) if arm is not None]

    @property
    def as_printed(self) -> dict[str, ArmResult]:
        """The paper's results, METHOD before METHOD_corr."""
        return {arm: self.paper[arm] for arm in self.compared if arm in self.paper}

    def to_json(self) -> dict[str, object]:
        """Return the dictionary of metrics.json."""
        content: dict[str, object] = {f.name: getattr(self, f.name) for f in fields(self)}
        for group in ("arms", "baselines", "paper"):
            content[group] = {name: r.to_json() for name, r in getattr(self, group).items()}
        return content

    @staticmethod
    def from_json(content: Mapping[str, object]) -> "Record":
        """Read the dictionary of metrics.json."""
        values = {field.name: content.get(field.name) for field in fields(Record)}
        for group in ("arms", "baselines", "paper"):
            results = cast("Mapping[str, Json]", values[group] or {})
            values[group] = {name: ArmResult.from_json(r) for name, r in results.items()}
        return Record(**values)  # pyright: ignore[reportArgumentType] (our own file)


COMMIT_SEPARATOR = " / "  # between the commits of an arm that was trained by more than one


def place_of(scale: str, data: str, identity: str, seed: int) -> Path:
    """Return the folder of an experiment below results/ and runs/; seed 0 goes without saying."""
    return Path(scale, data, identity if seed == 0 else f"{identity}-seed{seed}")


def read_record(path: Path) -> Record:
    """Read a metrics.json.

    Raises:
        CorrmatError: it is no record, or cut short.
    """
    try:
        return Record.from_json(json.loads(path.read_text()))
    except (ValueError, TypeError, AttributeError) as error:
        raise CorrmatError(f"{path} is no record, or cut short: {error}") from error


def read_records(results: Path) -> list[Record]:
    """Read every record below a folder, ordered by scale, experiment, data and seed."""
    paths = results.glob("*/*/[!.]*/metrics.json")  # not those of a record that is half written
    records = [read_record(path) for path in paths]
    return sorted(records, key=lambda r: (r.scale, r.id, r.data, r.seed))


def read_snapshots(folder: Path) -> list[PairSnapshot]:
    """Read the snapshots of a record; none for networks without matches."""
    path = folder / "snapshots.json"
    if not path.is_file():
        return []
    return [PairSnapshot.from_json(content) for content in json.loads(path.read_text())]


def defined(value: float | None) -> float | None:
    """Return None for a value that is missing or NaN."""
    return None if value is None or math.isnan(value) else float(value)


def _metrics(content: Json, skip: Iterable[str] = ()) -> Metrics:
    """Read metrics; null stands for NaN."""
    values = {name: value for name, value in content.items() if name not in skip}
    return {name: math.nan if v is None else cast(float, v) for name, v in values.items()}
