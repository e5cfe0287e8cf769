"""Models against each other on the same frozen pairs."""

import json
import re
from dataclasses import asdict

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree

from corrmat.calibration import Scores
from corrmat.cli import main
from corrmat.data import registry
from corrmat.data.scan_pairs import OVERLAP, make_object_pair, make_room_pair
from corrmat.errors import CorrmatError
from corrmat.registration import benchmark, shipping
from corrmat.reporting import comparisons, confidences, training_runs
from corrmat.reporting.model_results import write_comparison


@pytest.fixture
def pairs(monkeypatch):
    from corrmat.data.shapes import dataset as shapes

    few = shapes.load("test", 6)
    monkeypatch.setitem(registry.DATASETS, "shapes", lambda split, count, root: few)
    return benchmark.frozen_pairs("clean", points=256, count=4)


def test_pairs_are_frozen_and_spread_over_the_split(pairs):
    again = benchmark.frozen_pairs("clean", points=256, count=4)
    assert torch.equal(pairs.source, again.source)
    assert pairs.shape.tolist() == [0, 2, 3, 5]
    assert pairs.source.shape == (4, 256, 6)
    real = benchmark.frozen_pairs("real", points=256, count=4)
    assert real.source.shape == real.target.shape == (4, 179, 6)


def test_who_knows_the_truth_scores_everything_and_who_does_not_nothing(pairs, monkeypatch):
    def answer(source, target, model):
        index = next(i for i, c in enumerate(pairs.source) if np.allclose(c.numpy(), source))
        transform = np.eye(4)
        transform[:3, :3] = pairs.rotation[index]
        transform[:3, 3] = pairs.translation[index]
        if model == "wrong":
            transform[:3, 3] += 0.5
            transform[:3, :3] = transform[:3, :3] @ np.diag([1.0, -1, -1])
        result = type("Result", (), {})()
        result.transform, result.seconds = transform, 0.01
        result.scores = Scores(1.0, 1.0)
        return result

    monkeypatch.setattr(benchmark, "register", answer)
    rows = benchmark.compare(pairs, ["right", "wrong"])
    assert rows["right"].recall_5deg == rows["right"].recall_adds == 1
    assert rows["right"].mean_deg < 0.05
    assert rows["wrong"].recall_5deg == rows["wrong"].recall_adds == 0
    assert rows["wrong"].mean_deg == pytest.approx(180, abs=0.1)
    assert rows["right"].ms == pytest.approx(10)


def test_pairs_of_large_and_of_small_clouds_make_one_record():
    few = benchmark.frozen_pairs("clean", points=256, count=2)
    of_small, of_large = Scores(0.9, 0.8), Scores(0.9, 0.8, 0.1, 2)
    small, large = (benchmark.Outcome(1, 0, 5, scores) for scores in (of_small, of_large))
    assert benchmark.summarise(few, [small, large]).scores == [of_small, of_large]
    result = benchmark.summarise(few, [small, small])
    assert "coherence" not in result.per_pair
    assert result.scores == [of_small] * 2


def test_the_command_prints_one_table_and_writes_a_record(pairs, tmp_path, capsys):
    path = tmp_path / "results" / "register" / "clean-shapes-256.json"
    words = ["compare", "icp,corrmat", "--protocol", "clean", "--points", "256"]
    assert main([*words, "--pairs", "4", "--record", str(path)]) == 0
    shown = capsys.readouterr().out
    for word in ("4 pairs", "recall at 5°", "recall ADD-S", "ms a pair", "icp", "corrmat"):
        assert word in shown
    record = json.loads(path.read_text())
    assert record["pairs"] == 4
    assert len(record["models"]["icp"]["per_pair"]["rotation_error_deg"]) == 4
    assert record["models"]["corrmat"]["recall_5deg"] >= record["models"]["icp"]["recall_5deg"]
    summary = comparisons.comparison_summary(tmp_path / "results")
    assert summary.splitlines()[0] == "| pairs | data | points | icp | corrmat |"
    assert re.match(
        r"\| clean \| shapes \| 256 \| \d+% \| \d+% \(\d+ to \d+\) \|", summary.splitlines()[2]
    )
    rows = comparisons.comparison_table(tmp_path / "results").splitlines()[2:]
    assert [row.split(" | ")[3] for row in rows] == ["icp", "corrmat"]
    confidence = confidences.confidence_table(tmp_path / "results")
    rows = [row.split(" | ") for row in confidence.splitlines() if "| shapes |" in row]
    assert sum(int(row[2]) for row in rows) == 4
    assert "4 pairs of small clouds: expected calibration error over 10 bins 0." in confidence


def test_unrelated_pairs_are_spread_and_have_the_target_of_another_pair():
    pairs = benchmark.frozen_pairs("clean", points=256, count=6)
    unrelated_pairs = benchmark.unrelated(pairs, 3)
    assert torch.equal(unrelated_pairs.source, pairs.source[[0, 2, 5]])
    assert torch.equal(unrelated_pairs.target, pairs.target[[2, 4, 1]])
    assert len(benchmark.unrelated(pairs, 9)) == 6


def test_unrelated_clouds_are_of_different_families():
    labels = registry.load_clouds("shapes", "test").labels
    pairs = benchmark.frozen_pairs("clean", points=256)
    unrelated_pairs = benchmark.unrelated(pairs, 60)
    is_same = (unrelated_pairs.target[:, None] == pairs.target).all((2, 3))
    assert is_same.sum(1).tolist() == [1] * 60
    of_target = pairs.shape[is_same.int().argmax(1)]
    assert (labels[unrelated_pairs.shape] != labels[of_target]).all()


def test_unrelated_pairs_are_counted_below_the_confidence(tmp_path):
    pairs = benchmark.unrelated(benchmark.frozen_pairs("clean", points=256, count=3), 2)
    (tmp_path / "register").mkdir()
    scores = Scores(0.0, 0.0, 0.0, 0.0)
    result = benchmark.summarise(pairs, [benchmark.Outcome(90, 1, 5, scores)] * 2)
    write_comparison(
        tmp_path / "register" / "rooms-procedural-256.json",
        {"corrmat": result},
        {"protocol": "rooms", "points": 256},
    )
    entry = {"protocol": "rooms", "points": 256, "result": asdict(result)}
    (tmp_path / confidences.UNRELATED).write_text(json.dumps({"pairs": [entry, entry]}))
    last = confidences.confidence_table(tmp_path).splitlines()[-1]
    assert last == "4 unrelated pairs of rooms: 0 aligned, 0 probably aligned, 4 doubtful."


def test_calibration_intervals_and_paired_test_by_hand():
    promised = np.array([0.05, 0.05, 0.95, 0.95])
    error = confidences.expected_calibration_error(promised, np.array([False, True, True, True]))
    assert error == pytest.approx((0.9 + 0.1) / 4)
    # Two chances of a half: both right, or none, is an error of a half; else there is none.
    assert confidences.calibration_error_by_chance(np.array([0.5, 0.5])) == (0, 0.5)
    assert confidences.calibration_error_by_chance(np.ones(9)) == (0, 0)
    ours = np.array([True] * 9 + [False])
    assert comparisons._wilson(ours) == "60 to 98"
    theirs = np.array([True] * 3 + [False] * 6 + [True])
    # Six pairs for ours, one against: 2 (1 + 7) / 2^7.
    assert comparisons._mcnemar(ours, theirs) == pytest.approx(0.125)
    assert comparisons._mcnemar(ours, ours) == 1


def test_what_cannot_be_compared_is_said(pairs):
    with pytest.raises(CorrmatError, match="points = 2000"):
        benchmark.frozen_pairs("real", points=2000)
    assert benchmark.frozen_pairs("paper", points=1500, count=1).target.shape[1] == 1500
    with pytest.raises(CorrmatError, match="needs its folder"):
        benchmark.frozen_pairs("real", data="modelnet40")
    assert main(["compare", "nobody", "--points", "64", "--pairs", "1"]) == 2


def test_the_training_of_the_shipped_weights_is_drawn(tmp_path):
    training_runs.draw_training(tmp_path)
    recalls = {"real": 0.5, "views": 0.7, "clean": 0.9}
    points = [{"pairs_seen": 100 * i, "loss": 9.0 - i} for i in range(1, 4)]
    for before in (0, 300):
        run = {"before": before, "pairs": before + 300, "curve": points, "validation": recalls}
        shipping.add_training(tmp_path, run)
        recalls = {"real": 0.57, "views": 0.71, "clean": 0.88}
    training_runs.draw_training(tmp_path)
    assert (tmp_path / "register" / "training.png").stat().st_size > 10_000
    # From 300 to 600 pairs is one doubling.
    assert "real +7.0, views +1.0, clean -2.0." in training_runs.doubling_summary(tmp_path)


def test_the_table_of_the_choice_has_a_row_for_all_weights(tmp_path):
    assert comparisons.choice_table(tmp_path) == "No choice is recorded."
    tried = {"0.0, 0.0": {"recall_5deg": 0.5, "recall_adds": 0.25}}
    path = tmp_path / "register" / "choice.json"
    path.parent.mkdir()
    counts = {"pairs": 8, "candidates": 11.4, "distinct": 2.0}
    real = {**counts, "weights": tried, "right_matches": {"64": 0.475}}
    path.write_text(json.dumps({"real": real}))
    assert "| 0.0, 0.0 | 50.0%, 25.0% |" in comparisons.choice_table(tmp_path)
    assert "| right matches, 64 anchors | 47.5% |" in comparisons.choice_table(tmp_path)
    assert "in the mean: 11, 2.0 of them different (real)" in comparisons.choice_table(tmp_path)


def test_the_choice_in_large_clouds_has_a_column_a_record(tmp_path):
    assert comparisons.large_choice_table(tmp_path) == "No choice is recorded."
    folder = tmp_path / "register"
    folder.mkdir()
    for protocol, share in (("dense", 0.5), ("rooms", 0.75)):
        choice = {"in use": {"recall_5deg": share, "recall_adds": share / 2}}
        record = {"protocol": protocol, "choice": choice}
        (folder / f"{protocol}-procedural-20000.json").write_text(json.dumps(record))
    rows = comparisons.large_choice_table(tmp_path).splitlines()
    assert rows[0] == "| candidates and weights | dense | rooms |"
    assert rows[2] == "| in use | 50%, 25% | 75%, 38% |"


def test_fragments_of_a_room_overlap_in_part_and_lie_on_each_other():
    pair, again = (make_room_pair(3, 2000, "test") for _ in range(2))
    np.testing.assert_array_equal(pair.source, again.source)
    moved = pair.source @ pair.rotation.T + pair.translation
    near = KDTree(pair.target).query(moved)[0] < 0.2
    assert near.mean() == pytest.approx(pair.overlap, abs=0.1)
    assert OVERLAP[0] < pair.overlap < OVERLAP[1]
    assert 2 < np.ptp(pair.target, axis=0).max() < 10  # metres
    assert not np.array_equal(pair.source, make_room_pair(3, 2000, "val").source)


def test_rooms_are_a_protocol():
    pairs = benchmark.frozen_pairs("rooms", points=500, count=2)
    assert pairs.source.shape == pairs.target.shape == (2, 500, 3)
    truth = np.eye(4)
    truth[:3, :3], truth[:3, 3] = pairs.rotation[1], pairs.translation[1]
    assert max(benchmark.errors(pairs, 1, truth)) < 1e-4
    assert set(benchmark.compare(pairs, ["icp"])) == {"icp"}


@pytest.mark.parametrize("index", [0, 1])  # what cameras see, and crops
def test_dense_scans_of_an_object_lie_on_each_other(index):
    pair, again = (make_object_pair(index, 2000, "test") for _ in range(2))
    np.testing.assert_array_equal(pair.source, again.source)
    moved = pair.source @ pair.rotation.T + pair.translation
    near = KDTree(pair.target).query(moved)[0] < 0.1
    assert 0.25 < near.mean() < 1  # a part of the object is in one scan alone
    assert KDTree(pair.target).query(moved)[0].min() > 0  # no shared point
    assert not np.array_equal(pair.source, make_object_pair(index, 2000, "val").source)


def test_scans_of_fewer_points_repeat_some_in_a_batch():
    few = benchmark.SCANS["dense"](0, 50, "test")
    many = few._replace(source=np.vstack([few.source, few.source[:7] + 1]))
    pairs = benchmark._pair_scans([few, many])
    np.testing.assert_array_equal(pairs.source[0, 50:], few.source[:7])
    np.testing.assert_array_equal(pairs.source[1], many.source)
    assert pairs.target.shape == (2, 50, 3)


def test_scans_and_scenes_have_tables(tmp_path):
    assert "benchmarks/real_scans.py" in comparisons.real_scans_table(tmp_path)
    assert "benchmarks/other_scenes.py" in comparisons.other_scenes_table(tmp_path)
    (tmp_path / "register").mkdir()
    row = {"median_deg": 0.123, "verdicts": [3, 1, 1], "registrations": 5}
    scans = {"scans": "owl", "points": [1200, 900], "right": {"corrmat": 4, "icp": 1}, "seconds": 1}
    strangers = {"scans": "owl, cat", "right": None, "median_deg": None}
    for path, rows in (
        (comparisons.REAL_SCANS, [row | scans, row | scans | strangers]),
        (comparisons.OTHER_SCENES, [row | {"scenes": "hills", "right": 4}]),
    ):
        (tmp_path / path).write_text(json.dumps({"rows": rows}))
    owl, strange, total = comparisons.real_scans_table(tmp_path).splitlines()[2:]
    assert "| 4 of 5 | 1 of 5 |" in total
    assert owl == "| owl | 1,200 and 900 | 4 of 5 | 1 of 5 | 0.12 | 3, 1, 1 | 1.0 |"
    assert strange == "| owl, cat | 1,200 and 900 |  |  |  | 3, 1, 1 | 1.0 |"
    hills = comparisons.other_scenes_table(tmp_path).splitlines()[-1]
    assert hills == "| hills | 4 of 5 | 0.12 | 3, 1, 1 |"
