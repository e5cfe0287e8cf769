"""The ledger of claims: intervals from pairs, and verdicts by the rule."""

import dataclasses
import math

import numpy as np
import pytest

from corrmat.reporting import claims, intervals
from corrmat.reporting.claims import Evidence, verdict_of_ratio
from corrmat.reporting.intervals import Estimate, PairErrors
from corrmat.reporting.record import ArmResult, Record


def errors(values, correct=None, band=None):
    values = np.asarray(values, float)
    correct = np.full(len(values), np.nan) if correct is None else np.asarray(correct, float)
    band = np.zeros(len(values), int) if band is None else np.asarray(band)
    return PairErrors(values, correct, np.full(len(values), 10.0), band)


def drawn(scale, size=300, seed=0):
    return errors(scale * np.random.default_rng(seed).rayleigh(size=size))


def evidence(method, method_corr, identity=90.0, bands_deg=(), curves=((), ())):
    arms = {
        name: ArmResult({}, pairs_seen=1000, curve=list(curve))
        for name, curve in zip(("DCP", "DCP_corr"), curves, strict=True)
    }
    paper = {
        "DCP": ArmResult({"relative_euler_rmse_deg": 8.0}),
        "DCP_corr": ArmResult({"relative_euler_rmse_deg": 2.0}),
    }
    record = Record(
        "1.1", "full clouds", "laptop", "shapes", "DCP", "DCP", "DCP_corr", [], 0, None, {}, {}, "",
        list(bands_deg), arms, {}, paper,
    )  # fmt: skip
    return Evidence(record, {"DCP": method, "DCP_corr": method_corr}, identity)


def test_the_interval_covers_the_truth_as_often_as_it_says():
    """Of 200 samples, about 95 % have the true median within their interval."""
    truth = np.sqrt(2 * np.log(2))
    found = [intervals.estimate_median_rotation(drawn(1.0, 80, seed)) for seed in range(200)]
    covered = np.mean([e.low <= truth <= e.high for e in found])
    assert 0.89 < covered <= 1
    assert all(e.low <= e.value <= e.high for e in found)


def test_pairs_are_resampled_together():
    """The ratio of two arms that fail on the same pairs is known better than either median."""
    one = drawn(1.0)
    other = errors(one.rotation_deg / 2)
    ratio = intervals.ratio_of_medians(one, other)
    assert (ratio.low, ratio.value, ratio.high) == pytest.approx((2, 2, 2))


def test_matches_are_shares_of_points_not_of_pairs():
    share = intervals.estimate_match_accuracy(errors([1, 1], correct=[10, 5]))
    assert share.value == 0.75


def test_equal_arms_have_a_large_p_and_others_a_small_one():
    assert intervals.p_of_equal_errors(drawn(1.0), drawn(1.0)) == 1
    assert intervals.p_of_equal_errors(drawn(1.0, seed=1), drawn(1.0, seed=2)) > 0.01
    assert intervals.p_of_equal_errors(drawn(1.0, seed=1), drawn(0.5, seed=2)) < 1e-6


@pytest.mark.parametrize(
    ("ratio", "paper", "learnt", "verdict"),
    [
        ((9, 8, 10), 10, True, "confirmed"),
        ((5, 4, 6), 10, True, "confirmed"),  # half of the paper's ratio
        ((4.9, 4, 6), 10, True, "confirmed in direction"),
        ((9, 8, 10), None, True, "confirmed in direction"),
        ((1.1, 0.9, 1.3), 1, True, "not shown"),
        ((0.8, 0.7, 0.9), 1, True, "contradicted"),
        ((300, 200, 400), 10, False, "not shown"),  # an opponent that learnt nothing
        ((math.nan, math.nan, math.nan), None, True, "not shown"),  # neither arm errs at all
    ],
)
def test_verdicts(ratio, paper, learnt, verdict):
    assert verdict_of_ratio(Estimate(*ratio), paper, learnt) == verdict


def test_an_arm_at_the_identity_guess_shows_nothing():
    claim = claims.less_error(evidence(drawn(60.0), drawn(0.3)))
    assert claim.verdict == "not shown"
    assert "identity" in claim.ours
    claim = claims.less_error(evidence(drawn(6.0), drawn(0.3)))
    assert claim.verdict == "confirmed"
    assert claim.paper == "8 → 2 deg: 4 times"


def test_sooner_counts_the_pairs_to_the_others_best_error():
    def curve(*values, every=250.0):
        return [
            {"pairs_seen": every * (i + 1), "rotation_error_deg_mean": v}
            for i, v in enumerate(values)
        ]

    for baseline, treatment, verdict in (
        (curve(9, 8, 7, 4), curve(9, 3, 2, 1), "confirmed"),
        (curve(9, 8, 7, 4), curve(9, 8, 3, 1), "confirmed in direction"),
        (curve(9, 8, 7, 4), curve(9, 8, 7, 4), "not shown"),
        (curve(9, 8, 7, 4), curve(9, 8, 7, 6), "contradicted"),
        (curve(9, 4, math.nan, 80), curve(9, 8, 3, 1), "contradicted"),  # diverged
        (curve(math.nan, math.nan), curve(9, 8), "not shown"),
    ):
        judged = claims.sooner(evidence(drawn(6.0), drawn(0.3), curves=(baseline, treatment)))
        assert judged.verdict == verdict


def test_a_curve_with_errors_that_are_no_numbers_or_without_a_point():
    """NaN counts as the worst error, wherever it stands; no validation at all settles nothing."""
    nan = float("nan")
    for order in ((nan, 3.0, 2.0), (3.0, nan, 2.0), (3.0, 2.0, nan)):
        values = [
            {"pairs_seen": 250.0 * i, "rotation_error_deg_mean": v} for i, v in enumerate(order)
        ]
        faster = [{"pairs_seen": 100.0, "rotation_error_deg_mean": 1.0}]
        seen = evidence(drawn(6.0), drawn(0.3), curves=(values, faster))
        assert claims.sooner(seen).verdict == "confirmed"
        seen.record.controls.append(claims.HIGH_RATE_CONTROL)
        seen.record.arms[claims.HIGH_RATE_CONTROL] = ArmResult({}, curve=values)
        seen.errors[claims.HIGH_RATE_CONTROL] = drawn(3.0)
        assert claims.unstable_at_high_rates(seen).verdict == "confirmed"
    assert claims.sooner(evidence(drawn(6.0), drawn(0.3))) is None


def test_the_verdicts_are_counted():
    claim = claims.Claim("", "", "", "", "confirmed")
    other = dataclasses.replace(claim, verdict="not shown", kind="registers better")
    assert claims.count_verdicts([claim, other, claim]) == (
        "*registers better* (1 records): 0 confirmed, 0 confirmed in direction, 1 not shown, "
        "0 contradicted; "
        "*other claims* (2 records): 2 confirmed, 0 confirmed in direction, 0 not shown, "
        "0 contradicted"
    )


def test_the_summary_has_a_row_a_claim_and_a_column_a_scale():
    one = claims.Claim("b", "", "", "laptop, shapes", "confirmed")
    same = [one, dataclasses.replace(one, where="laptop, shapes, seed 1")]
    longer = dataclasses.replace(one, where="overnight, shapes", verdict="not shown")
    other = claims.Claim("a", "", "", "overnight, shapes", "contradicted")
    assert claims.summarise_claims([*same, longer, other]).splitlines() == [
        "| claim | laptop | overnight |",
        "|---|---|---|",
        "| a |  | 1 contradicted |",
        "| b | 2 confirmed | 1 not shown |",
    ]


def test_growth_over_bands():
    edges = (0, 30, 60)
    flat = errors(
        [*drawn(1.0).rotation_deg, *drawn(1.2, seed=1).rotation_deg], band=[0] * 300 + [1] * 300
    )
    steep = dataclasses.replace(flat, rotation_deg=flat.rotation_deg * (1 + 4 * flat.band))
    for treatment, verdict in ((flat, "confirmed"), (steep, "contradicted")):
        judged = claims.flat_over_misalignment(evidence(flat, treatment, bands_deg=edges))
        assert judged.verdict == verdict


@pytest.mark.parametrize(
    ("scales", "verdict"),
    [
        ((3.0, 0.3), "confirmed"),
        ((3.0, 30.0), "contradicted"),
        ((70.0, 0.3), "not shown"),  # METHOD learnt nothing
    ],
)
def test_lower_in_every_band(scales, verdict):
    one = errors([*drawn(1.0).rotation_deg, *drawn(1.2).rotation_deg], band=[0] * 300 + [1] * 300)
    arms = [dataclasses.replace(one, rotation_deg=scale * one.rotation_deg) for scale in scales]
    judged = claims.lower_in_every_band(evidence(*arms, bands_deg=(0, 30, 60)))
    assert judged.verdict == verdict


def test_the_last_quarter_of_a_training_is_a_quarter_of_its_pairs():
    """3.1 on shapes: 4,800 pairs, six validations; between the last two lies a sixth."""
    matches = (0.195, 0.27, 0.294, 0.354, 0.395, 0.402)
    curve = [
        {"pairs_seen": 800 * (n + 1), "match_accuracy": share} for n, share in enumerate(matches)
    ]
    treatment = errors(np.ones(50), correct=np.full(50, 4.0))
    judged = claims.below_seventy_per_cent(evidence(drawn(1), treatment, curves=((), curve)))
    assert judged is not None
    assert judged.verdict == "not shown"
    assert "2.8 points" in judged.ours


def test_whether_it_still_learns_needs_more_than_a_few_validations():
    curve = [{"pairs_seen": n, "match_accuracy": 0.5} for n in (100, 200, 300)]
    few = evidence(drawn(1), errors(np.ones(50), correct=np.full(50, 5.0)), curves=((), curve))
    assert claims.below_seventy_per_cent(few) is None
    many = [*curve, {"pairs_seen": 400, "match_accuracy": 0.5}]
    enough = evidence(drawn(1), errors(np.ones(50), correct=np.full(50, 5.0)), curves=((), many))
    assert claims.below_seventy_per_cent(enough).verdict == "confirmed"
