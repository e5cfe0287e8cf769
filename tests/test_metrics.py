import math

import pytest
import torch
from conftest import random_rotation
from scipy.spatial.transform import Rotation
from twins import chamfer_loops

from corrmat import metrics
from corrmat.data.datamodule import RegistrationDataModule
from corrmat.ops import rigid
from corrmat.ops.correspondence import SoftCorrespondence
from corrmat.types import Prediction


@pytest.fixture
def batch():
    data = RegistrationDataModule(
        num_points=24, keep=0.75, batch_size=6, test_shapes=6, train_shapes=2
    )
    return next(iter(data.test_dataloader()))


def perfect(batch):
    m = batch.target.shape[1]
    one_hot = torch.nn.functional.one_hot(batch.match, m).float()
    c = SoftCorrespondence(one_hot * 50, torch.eye(m).expand(len(batch), m, m))
    return Prediction(batch.rotation, batch.translation, c)


def test_a_perfect_prediction_has_the_perfect_score(batch):
    scores = metrics.RegistrationMetrics()
    scores.update(perfect(batch), batch)
    values = scores.compute()
    assert values.pop("match_accuracy") == 1
    assert values.pop("recall@5deg_0.05") == 1
    assert values.pop("pairs") == 6
    assert math.isnan(values.pop("transposed_match_accuracy"))  # asks for clouds of one size
    assert math.isnan(values.pop("outlier_precision"))  # no such class
    assert math.isnan(values.pop("outlier_recall"))
    assert math.isnan(values.pop("outlier_r_precision"))
    assert all(value == pytest.approx(0, abs=1e-5) for value in values.values()), values


def test_the_released_match_count_gives_a_perfect_prediction_almost_nothing():
    """It compared the matrix with its transpose: only fixed points and swaps count."""
    match = torch.tensor([[1, 2, 0, 3, 5, 4]])
    assert metrics.num_correct(match, match, 6).tolist() == [6]
    assert metrics.num_correct_transposed(match, match).tolist() == [3]
    assert metrics.num_correct_transposed(match.argsort(), match).tolist() == [6]
    data = RegistrationDataModule(num_points=200, batch_size=8, test_shapes=8, train_shapes=2)
    pairs = next(iter(data.test_dataloader()))
    scores = metrics.RegistrationMetrics()
    scores.update(perfect(pairs), pairs)
    assert scores.compute()["match_accuracy"] == 1
    assert 0 < scores.compute()["transposed_match_accuracy"] < 0.03


def test_angles_are_exact_near_zero_and_near_180():
    for angle in (0.0, 1e-6, 1e-3, 1.0, 90.0, 179.0, 179.9999, 180.0):
        turned = Rotation.from_rotvec([0, 0, math.radians(angle)]).as_matrix()
        actual = metrics.rotation_error_deg(
            torch.eye(3).double()[None], torch.from_numpy(turned)[None]
        )
        assert float(actual) == pytest.approx(angle, abs=1e-9)


def test_the_same_rotation_in_float32_is_no_error(generator):
    r = random_rotation(100, generator).float()
    assert metrics.rotation_error_deg(r, r).max() < 1e-4


def test_naive_euler_angles_wrap_where_the_relative_ones_do_not():
    """The trap of the released PCRNet scripts: one degree apart reads as 359."""
    a, b = (Rotation.from_euler("z", x, degrees=True).as_matrix() for x in (179.5, -179.5))
    pair = torch.from_numpy(a)[None], torch.from_numpy(b)[None]
    assert float(metrics.rotation_error_deg(*pair)) == pytest.approx(1)
    assert float(metrics.relative_euler_error_deg(*pair)[0, 0].abs()) == pytest.approx(1)
    assert float(metrics.naive_euler_error_deg(*pair)[0, 0].abs()) == pytest.approx(359)


def test_matches_count_only_rows_that_have_one():
    match = torch.tensor([[0, 1, 2, -1, 5]])
    predicted = torch.tensor([[0, 1, 0, 3, 5]])
    assert metrics.num_correct(predicted, match, num_target=5).tolist() == [2]
    assert metrics.match_accuracy(predicted, match, 5).item() == pytest.approx(2 / 3)
    pairs = torch.cat([predicted] * 2), torch.cat([match, torch.full_like(match, -1)])
    assert metrics.match_accuracy(*pairs, 5).item() == pytest.approx(2 / 3)  # not NaN
    assert metrics.match_accuracy(predicted, torch.full_like(match, -1), 5).item() == 0


def test_chamfer_equals_its_twin(batch, generator):
    prediction = Prediction(
        random_rotation(6, generator).float(), torch.randn(6, 3, generator=generator)
    )
    batch.clean = batch.clean[:, :50]
    actual = metrics.chamfer(prediction, batch)
    moved = rigid.apply(prediction.rotation, prediction.translation, batch.source[..., :3])
    clean_target = rigid.apply(batch.rotation, batch.translation, batch.clean)
    clean_source = rigid.apply(prediction.rotation, prediction.translation, batch.clean)
    for i in range(2):
        twin = chamfer_loops(moved[i], clean_target[i], batch.target[i, :, :3], clean_source[i])
        assert float(actual[i]) == pytest.approx(twin, rel=1e-5)


def test_batches_of_any_size_give_one_result(batch):
    """Never a mean of batch means: six pairs at once, or one and five."""
    import dataclasses

    def part(rows):
        return dataclasses.replace(
            batch, **{f.name: getattr(batch, f.name)[rows] for f in dataclasses.fields(batch)}
        )

    def wrong(b):
        c = SoftCorrespondence(b.source[..., :3], b.target[..., :3])
        return Prediction(torch.eye(3).expand(len(b), 3, 3), torch.zeros(len(b), 3), c)

    results = []
    for split in ([slice(0, 6)], [slice(0, 1), slice(1, 6)]):
        scores = metrics.RegistrationMetrics()
        for rows in split:
            scores.update(wrong(part(rows)), part(rows))
        results.append(scores.compute())
    assert results[0] == pytest.approx(results[1], rel=1e-6, nan_ok=True)
    assert results[0]["rotation_error_deg_mean"] > 1


def test_no_answer_is_counted_and_never_scored_as_one(batch):
    broken = perfect(batch)
    broken.rotation = broken.rotation.clone()
    broken.rotation[2] = torch.nan
    scores = metrics.RegistrationMetrics()
    scores.update(broken, batch)
    values = scores.compute()
    assert values["failed"] == 1
    assert math.isnan(values["rotation_error_deg_mean"])
    assert values["rotation_error_deg_median"] == pytest.approx(
        0, abs=1e-3
    )  # it is 180 degrees off
    assert values["recall@5deg_0.05"] == pytest.approx(5 / 6)


def test_a_network_without_matches_has_no_match_accuracy(batch):
    scores = metrics.RegistrationMetrics()
    scores.update(Prediction(batch.rotation, batch.translation), batch)
    assert math.isnan(scores.compute()["match_accuracy"])
