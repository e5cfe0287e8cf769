"""The ledger of claims: what the paper says, what our records say, and a verdict by a fixed rule.

docs/claims.md has the rule in words, and what of it came later than the records.
"""

import json
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import yaml

from corrmat.reporting.intervals import (
    Estimate,
    PairErrors,
    as_text,
    estimate_match_accuracy,
    estimate_median_rotation,
    p_of_equal_errors,
    ratio_of_medians,
    read_errors,
)
from corrmat.reporting.record import ArmResult, Record
from corrmat.reporting.tables import (
    arm_ratio,
    markdown_head,
    markdown_row,
    paper_metric,
    ratio_cell,
)

Verdict = Literal["confirmed", "confirmed in direction", "not shown", "contradicted"]
Kind = Literal["registers better", "converges sooner", "other claims"]
HIGH_RATE_CONTROL = "RPMNet_high_rate"
LEFT_IDENTITY = 0.5  # of identity's median error: an arm above it has learnt nothing to compare
NEAR_PAPER = 0.5  # of the paper's ratio: less is a confirmation of the direction only
FLAT = 2.0  # growth of the error from the first to the last band of table 1
STILL_LEARNING = 0.01  # gain of matches over the last quarter of a training that had not ended
MOST_MATCHES = 0.7  # that PCRNet_corr "could not achieve" in 3.1
HORN_DEG = 5.0  # at 40 % wrong matches, as the paper's text says of figure 2
HORN_LAST_DEG, HORN_NEAR = 80.0, 1.25  # at 99 %, as figure 2 shows; a larger factor contradicts it
RANDOM_DEG = 126.0  # mean angle between two random rotations: pi / 2 + 2 / pi
ALIKE, APART = 2.0, 0.2  # medians within this factor; shares of matches this far apart


@dataclass(frozen=True)
class Claim:
    """A claim of the paper, judged by one record."""

    words: str
    paper: str
    ours: str
    where: str
    verdict: Verdict
    kind: Kind = "other claims"
    verdict_by_paper_metric: Verdict | None = None  # of "registers better"; without an interval

    @property
    def scale(self) -> str:
        """Scale of the record, the first word of where it was trained."""
        return self.where.partition(",")[0]


@dataclass(frozen=True)
class Evidence:
    """A record with the errors of every pair of its arms and baselines."""

    record: Record
    errors: dict[str, PairErrors]
    identity_median_deg: float

    @property
    def baseline(self) -> PairErrors:
        """Errors of METHOD."""
        return self.errors[str(self.record.baseline)]

    @property
    def treatment(self) -> PairErrors:
        """Errors of METHOD_corr."""
        return self.errors[self.record.treatment]

    def left_identity(self, errors: PairErrors) -> bool:
        """Tell whether an arm is clearly better than guessing the identity."""
        return errors.median_deg < LEFT_IDENTITY * self.identity_median_deg


def read_evidence(record: Record, results: Path) -> Evidence:
    """Read what a claim needs of a record's folder."""
    folder = results / record.place
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # ten times as fast, where it is built
    config = yaml.load((folder / "config.yaml").read_text(), loader)
    data = config["arms"][record.treatment]["data"]
    # The angle is uniform, so its median is half of the largest.
    largest = record.bands_deg[-1] if record.bands_deg else float(data["rotation_deg"])
    return Evidence(record, read_errors(folder / "per_pair.csv"), largest / 2)


def verdict_of_ratio(ratio: Estimate, paper: float | None, baseline_learnt: bool) -> Verdict:
    """Judge "METHOD_corr errs less than METHOD".

    Args:
        ratio: of METHOD's median error to METHOD_corr's.
        paper: the same ratio in the paper; None if it gives none.
        baseline_learnt: whether METHOD left the identity guess; else it shows nothing.
    """
    if not baseline_learnt:
        return "not shown"
    if ratio.high < 1:
        return "contradicted"
    if not ratio.low > 1:  # NaN if both arms have no error at all
        return "not shown"
    near = paper is not None and ratio.value >= NEAR_PAPER * paper
    return "confirmed" if near else "confirmed in direction"


def less_error(evidence: Evidence) -> Claim:
    """METHOD_corr registers better than METHOD."""
    record = evidence.record
    ratio = ratio_of_medians(evidence.baseline, evidence.treatment)
    learnt = evidence.left_identity(evidence.baseline)
    theirs = by_paper_metric(record, record.paper)
    paper_ratio = arm_ratio(theirs)
    by_paper = arm_ratio(by_paper_metric(record, record.arms))
    p = p_of_equal_errors(evidence.baseline, evidence.treatment)
    flips = evidence.baseline.flipped, evidence.treatment.flipped
    arms = [
        as_text(estimate_median_rotation(e), "deg") for e in (evidence.baseline, evidence.treatment)
    ]
    ours = f"{arms[0]} → {arms[1]}: {as_text(ratio)} times"
    ours += f" (p {_p_text(p)}; flips {flips[0]} → {flips[1]})"
    if not learnt:
        identity = f"{evidence.identity_median_deg:g} deg"
        ours += f"; {record.baseline} errs by at least half of the identity guess's {identity}"
    return Claim(
        f"{record.id}: {record.treatment} registers better than {record.baseline} ({record.title})",
        f"{theirs[0]:.3g} → {theirs[1]:.3g} deg: {paper_ratio:.3g} times" if paper_ratio else "",
        ours,
        evidence.record.trained_on,
        verdict_of_ratio(ratio, paper_ratio, learnt),
        "registers better",
        None
        if by_paper is None
        else verdict_of_ratio(Estimate(by_paper, by_paper, by_paper), paper_ratio, learnt),
    )


def by_paper_metric(record: Record, results: Mapping[str, ArmResult]) -> list[float | None]:
    """Return METHOD's and METHOD_corr's error as the paper measures it.

    Args:
        record: whose arms and metric.
        results: its own arms, or those of the paper.
    """
    return [results[arm].overall(paper_metric(record)) for arm in record.compared]


def headline(evidence: Evidence) -> list[str]:
    """Return the cells of README's table: what both arms reached, and the verdict."""
    record = evidence.record
    arms = [
        as_text(estimate_median_rotation(e), "deg") for e in (evidence.baseline, evidence.treatment)
    ]
    judged = less_error(evidence)
    pairs = record.arms[record.treatment].pairs_seen
    ransac = evidence.errors.get("ransac")
    return [
        f"{record.id} {record.family}, {record.title}",
        *arms,
        f"{ransac.median_deg:.2g} deg" if ransac else "",
        as_text(ratio_of_medians(evidence.baseline, evidence.treatment)),
        ratio_cell(by_paper_metric(record, record.arms)),
        ratio_cell(by_paper_metric(record, record.paper)),
        f"{pairs:,} pairs, {record.data}",
        f"**{judged.verdict}**",
    ]


def sooner(evidence: Evidence) -> Claim | None:
    """METHOD_corr reaches METHOD's best error after fewer pairs."""
    record, name = evidence.record, "rotation_error_deg_mean"
    baseline, treatment = (record.arms[arm] for arm in record.compared)
    if not (baseline.curve and treatment.curve):
        return None
    # An error that is not a number is the worst there is.
    best = min(baseline.curve, key=lambda point: np.nan_to_num(point[name], nan=math.inf))
    goal, taken = best[name], best["pairs_seen"]
    needed = next((p["pairs_seen"] for p in treatment.curve if p[name] <= goal), math.inf)
    verdict: Verdict = "confirmed" if needed <= taken / 2 else "confirmed in direction"
    at_once = needed == treatment.curve[0]["pairs_seen"]
    if needed >= taken:
        verdict = "not shown" if needed == taken else "contradicted"
    if not (evidence.left_identity(evidence.baseline) and math.isfinite(goal)):
        verdict = "not shown"
    reached = "never" if math.isinf(needed) else f"after {needed:,.0f}"
    reached += ", its first validation" if at_once else ""
    goal_text = f"{goal:.3g} deg in validation, {record.baseline}'s best, after {taken:,.0f}"
    control = _high_rate_control(record)
    best_at_high_rate = ""
    if control is not None and record.arms[control].curve:
        error = np.nanmin([point[name] for point in record.arms[control].curve])
        best_at_high_rate = f"; {control}'s best is {error:.3g} deg"
    return Claim(
        f"{record.id}: {record.treatment} converges sooner",
        "half the epochs (1.1)",
        f"{goal_text} of {baseline.pairs_seen:,} pairs: reached {reached}{best_at_high_rate}",
        evidence.record.trained_on,
        verdict,
        "converges sooner",
    )


def flat_over_misalignment(evidence: Evidence) -> Claim:
    """Table 1: DCP_corr's error hardly grows with the initial misalignment."""
    record = evidence.record
    last = len(record.bands_deg) - 2
    first_band, last_band = (evidence.treatment.of_band(band) for band in (0, last))
    growth = ratio_of_medians(last_band, first_band)
    verdict: Verdict = "confirmed" if growth.high <= FLAT else "not shown"
    if growth.low > FLAT:
        verdict = "contradicted"
    if not evidence.left_identity(evidence.treatment):
        verdict = "not shown"
    return Claim(
        "1.4: DCP_corr's error hardly grows with the misalignment (table 1)",
        "0.005 to 0.010 deg: 2 times",
        f"median {first_band.median_deg:.2g} deg in the first band, {last_band.median_deg:.2g} in "
        f"the last: {as_text(growth)} times",
        evidence.record.trained_on,
        verdict,
    )


def lower_in_every_band(evidence: Evidence) -> Claim:
    """Table 2: RPMNet_corr's error is lower in every band."""
    bands = range(len(evidence.record.bands_deg) - 1)
    ratios = [
        ratio_of_medians(evidence.baseline.of_band(band), evidence.treatment.of_band(band))
        for band in bands
    ]
    better = sum(ratio.low > 1 for ratio in ratios)
    worse = sum(ratio.high < 1 for ratio in ratios)
    verdict: Verdict = "confirmed" if better == len(ratios) else "not shown"
    if worse:
        verdict = "contradicted"
    if not evidence.left_identity(evidence.baseline):
        verdict = "not shown"
    return Claim(
        "2.4: RPMNet_corr's error is lower in every band (table 2)",
        "6 of 6 bands",
        f"clearly lower in {better} of {len(ratios)} bands, higher in {worse}",
        evidence.record.trained_on,
        verdict,
    )


def loss_not_rate(evidence: Evidence) -> Claim | None:
    """RPMNet_corr's gain is the loss's, not the learning rate's: RPMNet at a high rate."""
    record = evidence.record
    control = _high_rate_control(record)
    if control is None:
        return None
    ratio = ratio_of_medians(evidence.errors[control], evidence.treatment)
    return Claim(
        f"{record.id}: RPMNet_corr registers better than RPMNet at a high rate",
        "(RPMNet was unstable at high rates)",
        f"{as_text(estimate_median_rotation(evidence.errors[control]), 'deg')} → "
        f"{as_text(estimate_median_rotation(evidence.treatment), 'deg')}: {as_text(ratio)} times",
        evidence.record.trained_on,
        verdict_of_ratio(ratio, None, evidence.left_identity(evidence.errors[control])),
    )


def unstable_at_high_rates(evidence: Evidence) -> Claim | None:
    """RPMNet "was unstable" at rates above 1e-4: the control trains at a higher one."""
    control = _high_rate_control(evidence.record)
    if control is None:
        return None
    ratio = ratio_of_medians(evidence.baseline, evidence.errors[control])
    curve = [p["rotation_error_deg_mean"] for p in evidence.record.arms[control].curve]
    worst = float(np.max(curve, initial=0.0))  # NaN if one of them is
    verdict: Verdict = "contradicted" if ratio.low > 1 else "not shown"
    if ratio.high < 1 or not math.isfinite(worst):
        verdict = "confirmed"
    return Claim(
        f"{evidence.record.id}: RPMNet is unstable at high rates",
        "trained at 1e-4 for that reason",
        f"steady 1e-4 to one cycle at a high rate: median error falls {as_text(ratio)} times, "
        f"worst validation {worst:.3g} deg",
        evidence.record.trained_on,
        verdict,
    )


def matches_say_more(evidence: Evidence) -> Claim | None:
    """Networks far apart in matches can register alike on identical points."""
    control = _high_rate_control(evidence.record)
    if control is None:
        return None
    fewer, more = (
        estimate_match_accuracy(e) for e in (evidence.errors[control], evidence.treatment)
    )
    ratio = ratio_of_medians(evidence.errors[control], evidence.treatment)
    alike = ratio.low >= 1 / ALIKE and ratio.high <= ALIKE
    apart = more.low - fewer.high >= APART
    return Claim(
        f"{evidence.record.id}: matches tell networks apart that degrees do not",
        "28.9 % → 99.7 %, 0.56 → 0.059 deg",
        f"{as_text(fewer, '%')} → {as_text(more, '%')}; medians {as_text(ratio)} times apart",
        evidence.record.trained_on,
        "confirmed" if alike and apart else "not shown",
    )


def _high_rate_control(record: Record) -> str | None:
    return HIGH_RATE_CONTROL if HIGH_RATE_CONTROL in record.controls else None


def below_seventy_per_cent(evidence: Evidence) -> Claim | None:
    """PCRNet_corr "could not achieve" 70 % of correct matches on 1024 points."""
    share, record = estimate_match_accuracy(evidence.treatment), evidence.record
    curve = record.arms[record.treatment].curve
    if len(curve) < 4:  # too few to tell whether it still learns
        return None
    pairs, matches = np.array([(p["pairs_seen"], p["match_accuracy"]) for p in curve]).T
    gain = matches[-1] - np.interp(0.75 * pairs[-1], pairs, matches)
    verdict: Verdict = "contradicted" if share.low > MOST_MATCHES else "not shown"
    if share.high < MOST_MATCHES and gain < STILL_LEARNING:
        verdict = "confirmed"
    return Claim(
        "3.1: PCRNet_corr cannot match 70 % of 1024 points",
        "63 %",
        f"{as_text(share, '%')} after {record.arms[record.treatment].pairs_seen:,} pairs, "
        f"{100 * gain:.2g} points of them in the last quarter",
        evidence.record.trained_on,
        verdict,
    )


_COMPARED: tuple[Callable[[Evidence], Claim | None], ...] = (less_error, sooner)
JUDGED: dict[str, tuple[Callable[[Evidence], Claim | None], ...]] = {
    "1.1": _COMPARED,
    "1.2": _COMPARED,
    "1.3": _COMPARED,
    "1.4": (less_error, flat_over_misalignment),
    "2.1": (*_COMPARED, loss_not_rate, unstable_at_high_rates, matches_say_more),
    "2.2": (*_COMPARED, loss_not_rate, unstable_at_high_rates),
    "2.3": (*_COMPARED, loss_not_rate, unstable_at_high_rates),
    "2.4": (less_error, lower_in_every_band, loss_not_rate),
    "3.1": (below_seventy_per_cent,),
    "3.2": _COMPARED,
    "3.3": _COMPARED,
    "outliers": _COMPARED,
}


def figure_2(results: Path) -> list[Claim]:
    """Horn's rotation from matches of which 40 %, or 99 %, are wrong."""
    claims = []
    for path in sorted(results.glob("*/robustness/curve.json")):
        if path.parts[-3] == "smoke":
            continue
        curve = json.loads(path.read_text())
        errors = dict(zip(curve["percent"], curve["curves"]["1024 points"]["mean"], strict=True))
        error, last = errors[40], errors[99]
        claims.append(
            Claim(
                "figure 2: matches are forgiving, at 40 % wrong ones",
                f"about {HORN_DEG:g} deg",
                f"{error:.3g} deg, mean, of 1024 points",
                path.parts[-3],
                "confirmed" if error <= HORN_DEG else "contradicted",
            )
        )
        claims.append(
            Claim(
                "figure 2: matches are forgiving, at 99 % wrong ones",
                f"about {HORN_LAST_DEG:g} deg",
                f"{last:.3g} deg, mean, of 1024 points; a random rotation is off by {RANDOM_DEG:g}",
                path.parts[-3],
                "confirmed" if last <= HORN_NEAR * HORN_LAST_DEG else "contradicted",
            )
        )
    return claims


def claims_of(records: Sequence[Record], results: Path) -> list[Claim]:
    """Judge every claim by every record that bears on it; smoke records bear on none."""
    judged = [
        claim for record in records if record.scale != "smoke" for claim in _judge(record, results)
    ]
    return sorted(judged, key=lambda claim: claim.words) + figure_2(results)


def _judge(record: Record, results: Path) -> list[Claim]:
    """Judge the claims that a record bears on."""
    if record.id not in JUDGED or not set(record.compared) <= set(record.paper):
        return []
    evidence = read_evidence(record, results)
    claims = (judge(evidence) for judge in JUDGED[record.id])
    return [claim for claim in claims if claim is not None]


def count_verdicts(claims: Sequence[Claim]) -> str:
    """Say how many verdicts the ledger has, of each kind of claim."""
    parts = []
    for kind in get_args(Kind):
        counts = Counter(claim.verdict for claim in claims if claim.kind == kind)
        if counts:
            each = ", ".join(f"{counts[verdict]} {verdict}" for verdict in get_args(Verdict))
            parts.append(f"*{kind}* ({counts.total()} records): {each}")
    return "; ".join(parts)


def summarise_claims(claims: Sequence[Claim]) -> str:
    """Build the table of how many records of each scale say what of a claim."""
    scales = list(dict.fromkeys(claim.scale for claim in claims))
    lines = markdown_head(["claim", *scales])
    for words in sorted({claim.words for claim in claims}):
        same = [claim for claim in claims if claim.words == words]
        counts = (Counter(c.verdict for c in same if c.scale == scale) for scale in scales)
        cells = [
            ", ".join(f"{count[each]} {each}" for each in get_args(Verdict) if count[each])
            for count in counts
        ]
        lines.append(markdown_row([words, *cells]))
    return "\n".join(lines)


def other_verdicts_by_paper_metric(claims: Sequence[Claim]) -> str:
    """Say which verdicts on "registers better" would differ by the paper's own metric."""
    judged = [claim for claim in claims if claim.verdict_by_paper_metric]
    others = [claim for claim in judged if claim.verdict != claim.verdict_by_paper_metric]
    each = "; ".join(
        f"{claim.words.partition(':')[0]} ({claim.where}) {claim.verdict_by_paper_metric} instead "
        f"of {claim.verdict}"
        for claim in others
    )
    return (
        "By the paper's own metrics, means and root mean squares without intervals, "
        f"{len(others)} of the {len(judged)} verdicts on *registers better* would differ"
        f"{': ' if others else ''}{each}."
    )


def verdicts(record: Record, results: Path) -> str:
    """Judge a record that was just written, claim by claim; empty if it bears on none."""
    if record.scale == "smoke":
        return "smoke scale: everything runs, and nothing is learnt"
    claims = _judge(record, results)
    return "\n".join(f"{claim.verdict}: {claim.words}\n    {claim.ours}" for claim in claims)


def markdown_claims(claims: Sequence[Claim]) -> str:
    """Build the ledger as a Markdown table."""
    heads = ["claim", "paper", "ours", "record", "verdict"]
    lines = markdown_head(heads)
    lines += [markdown_row([c.words, c.paper, c.ours, c.where, f"**{c.verdict}**"]) for c in claims]
    return "\n".join(lines)


def _p_text(p: float) -> str:
    return "< 0.001" if p < 0.001 else f"= {p:.2g}"
