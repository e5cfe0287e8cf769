import json
import math

import pytest
import torch

from corrmat.cli import main
from corrmat.reporting import robustness


def test_num_correct_give_the_right_rotation():
    assert robustness.wrong_matches(64, 0, 20).max() < 1e-5
    assert robustness.wrong_vector(0, 20).max() < 1e-5


def test_all_matches_wrong_say_nothing():
    assert robustness.wrong_matches(64, 100, 400).mean() > 80


@pytest.mark.parametrize("percent", [10, 40, 70])
def test_the_first_order_formula_is_near_the_mean_over_draws(percent):
    errors = robustness.wrong_matches(1024, percent, 300)
    spread = errors.std() / math.sqrt(len(errors))
    expected = robustness.expected_deg(1024, percent)
    assert abs(errors.mean() - expected) < 0.04 * expected + 3 * spread


def test_four_times_the_points_halve_the_error():
    assert robustness.expected_deg(400, 30) == pytest.approx(robustness.expected_deg(100, 30) / 2)
    assert robustness.points_for(robustness.expected_deg(200, 40), 40) == 200


def test_draws_are_a_function_of_the_seed_alone():
    first, again = (robustness.wrong_matches(128, 40, 50, seed=3) for _ in range(2))
    assert torch.equal(first, again)
    assert not torch.equal(first, robustness.wrong_matches(128, 40, 50, seed=4))
    assert torch.equal(robustness.wrong_vector(40, 50, 3), robustness.wrong_vector(40, 50, 3))


def test_the_papers_chart_comes_out_of_it():
    """Matches: within 2.5 deg at 1024 points up to 90 %. The vector: within 10 deg everywhere."""
    for percent, paper in robustness.PAPER["matches"].items():
        if percent <= 90:
            actual = robustness.wrong_matches(robustness.SHOWN, percent, 200).mean()
            assert abs(actual - paper) < 2.5
    for percent, paper in robustness.PAPER["rotation vector"].items():
        assert abs(robustness.wrong_vector(percent, 2000).mean() - paper) < 10


def test_the_command_writes_the_curve_and_the_picture(tmp_path, capsys):
    assert main(["robustness", "--scale", "smoke", "--results", str(tmp_path)]) == 0
    folder = tmp_path / "smoke" / "robustness"
    content = json.loads((folder / "curve.json").read_text())
    assert list(content["curves"]) == [
        "64 points", "512 points", "1024 points", "4096 points", "rotation vector"
    ]  # fmt: skip
    assert all(len(c["mean"]) == len(content["percent"]) for c in content["curves"].values())
    assert (folder / "curve.png").read_bytes().startswith(b"\x89PNG")
    assert "rotation vector" in capsys.readouterr().out
