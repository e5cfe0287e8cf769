import pytest
import torch

from corrmat.baselines import Identity, Radius
from corrmat.data.datamodule import RegistrationDataModule
from corrmat.metrics import RegistrationMetrics


@pytest.mark.parametrize("num_points", [100, 1024])
def test_distance_from_the_origin_solves_pairs_without_translation(num_points):
    data = RegistrationDataModule(
        num_points=num_points, rotation_deg=180, translation=0, batch_size=8, test_shapes=8
    )
    actual = RegistrationMetrics()
    for batch in data.test_dataloader():
        actual.update(Radius()(batch.source, batch.target), batch)
    values = actual.compute()
    assert values["match_accuracy"] > 0.999
    assert values["rotation_error_deg_mean"] < 0.05


def test_distance_from_the_origin_says_nothing_once_there_is_a_translation():
    data = RegistrationDataModule(num_points=100, batch_size=8, test_shapes=8)
    batch = next(iter(data.test_dataloader()))
    prediction = Radius()(batch.source, batch.target).correspondence.argmax()
    assert (prediction == batch.match).double().mean() < 0.2


def test_the_identity_is_as_wrong_as_the_pair_is_turned(generator):
    cloud = torch.randn(2, 5, 6, generator=generator)
    prediction = Identity()(cloud, cloud)
    assert torch.equal(prediction.rotation, torch.eye(3).expand(2, 3, 3))
    assert torch.equal(prediction.translation, torch.zeros(2, 3))
    assert prediction.correspondence is None
