"""Agreement with the released formulation, by the arrays that `parity.py` wrote."""

from dataclasses import replace

import numpy as np
import parity
import pytest
import torch
from torch.testing import assert_close

from corrmat.losses import ChamferLoss, CorrespondenceLoss, transformation_loss
from corrmat.reference import rename
from corrmat.types import PairBatch

# The released layer norm adds 1e-6 to a deviation near one; ours leaves it out.
NAMES = {name: 1e-5 if name == "dcp_transformer" else 1e-9 for name in parity.NETWORKS}


def load(name):
    arrays = np.load(parity.GOLDEN / f"{name}.npz")
    arrays = {key: torch.from_numpy(arrays[key]) for key in arrays}
    batch = PairBatch(
        arrays["source"], arrays["target"], arrays["rotation"], arrays["translation"],
        arrays["match"], arrays["source"][..., :3], torch.zeros(2, dtype=torch.int64),
    )  # fmt: skip
    return arrays, batch


@pytest.mark.parametrize(("name", "tolerance"), NAMES.items())
def test_pose_matrices_and_losses_in_evaluation_mode(name, tolerance):
    arrays, batch = load(name)
    with torch.no_grad():
        prediction = parity.network(name)(batch.source, batch.target)
    close = {"rtol": tolerance, "atol": tolerance}
    assert_close(prediction.rotation, arrays["rotation_pred"], **close)
    assert_close(prediction.translation, arrays["translation_pred"], **close)
    matrices = [step.correspondence for step in prediction.steps if step.correspondence]
    assert len(matrices) == sum(key.startswith("correspondence_") for key in arrays)
    for i, c in enumerate(matrices):
        assert_close(c.prob(), arrays[f"correspondence_{i}"], **close)
    if name == "pcrnet":
        assert_close(ChamferLoss().loss(prediction, batch), arrays["loss_chamfer"], **close)
        return
    loss = CorrespondenceLoss().loss(prediction, batch)
    assert_close(loss, arrays["loss_correspondence"], **close)
    if "loss_transformation" in arrays:
        pose = prediction.rotation, prediction.translation, batch.rotation, batch.translation
        assert_close(transformation_loss(*pose), arrays["loss_transformation"], **close)


@pytest.mark.parametrize(("name", "tolerance"), NAMES.items())
def test_loss_and_every_gradient_in_training_mode(name, tolerance):
    arrays, batch = load(name)
    network = parity.network(name).train()
    loss_mixin = ChamferLoss if name == "pcrnet" else CorrespondenceLoss
    loss = loss_mixin().loss(network(batch.source, batch.target), batch)
    loss.backward()
    (key,) = {f"train_loss_{kind}" for kind in ("chamfer", "correspondence")} & set(arrays)
    assert_close(loss, arrays[key], rtol=tolerance, atol=0)
    parameters = dict(network.named_parameters())
    assert {f"grad/{key}" for key in parameters} == {k for k in arrays if k.startswith("grad/")}
    largest = max(float(arrays[f"grad/{key}"].abs().max()) for key in parameters)
    for key, parameter in parameters.items():
        ours = parity.sample(parameter.grad)
        assert_close(ours, arrays[f"grad/{key}"], rtol=0, atol=tolerance * largest)


@pytest.mark.parametrize("name", NAMES)
def test_the_loss_in_float32(name):
    arrays, batch = load(name)
    single = replace(batch, source=batch.source.float(), target=batch.target.float())
    loss_mixin = ChamferLoss if name == "pcrnet" else CorrespondenceLoss
    with torch.no_grad():
        prediction = parity.network(name).float()(single.source, single.target)
        loss = loss_mixin().loss(prediction, single)
    (key,) = {"loss_chamfer", "loss_correspondence"} & set(arrays)
    assert_close(loss, arrays[key].float(), rtol=1e-5, atol=0)


@pytest.mark.parametrize(
    ("kind", "theirs", "ours"),
    [
        ("dcp", "emb_nn.conv1.weight", "embed.edge.0.linear.weight"),
        ("dcp", "emb_nn.bn5.running_var", "embed.norm.running_var"),
        ("dcp", "pointer.model.encoder.layers.0.self_attn.linears.1.bias",
         "pointer.encoder.self_attention.key.bias"),
        ("dcp", "pointer.model.decoder.layers.0.src_attn.linears.3.weight",
         "pointer.decoder.cross_attention.out.weight"),
        ("dcp", "pointer.model.decoder.layers.0.sublayer.2.norm.a_2",
         "pointer.decoder.norms.2.gain"),
        ("dcp", "pointer.model.decoder.norm.b_2", "pointer.decoder_norm.bias"),
        ("rpmnet", "feat_extractor.prepool.3.weight", "embed.edge.3.weight"),
        ("rpmnet", "feat_extractor.postpool.6.bias", "embed.out.bias"),
        ("rpmnet", "weights_net.postpool.0.weight", "annealing.pooled.0.weight"),
        ("pcrnet", "feature_model.conv5.bias", "embed.layers.8.bias"),
        ("pcrnet_corr", "emb_nn.bn2.weight", "embed.layers.4.weight"),
    ],
)  # fmt: skip
def test_the_authors_names_of_parameters(kind, theirs, ours):
    assert rename(kind, theirs) == ours
