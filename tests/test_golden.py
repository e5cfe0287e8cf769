"""Agreement with the original authors' implementations, where their arrays are at hand."""

import numpy as np
import pytest
import torch
from conftest import golden, shared, state_of

from corrmat import load_reference, metrics
from corrmat.errors import CorrmatError
from corrmat.losses import (
    ChamferLoss,
    CorrespondenceLoss,
    RegistrationLoss,
    correspondence_loss,
    transformation_loss,
)
from corrmat.networks import rpmnet
from corrmat.ops import rigid
from corrmat.reference import rename
from corrmat.types import PairBatch

NAMES = ["dcp_identity", "dcp_transformer", "dcp_transformer_partial"]
ULPS = 3e-7  # a relative change of the input that float32 rounding makes as well


@pytest.mark.parametrize("name", NAMES)
def test_dcp_in_evaluation_mode(name):
    arrays, hparams = golden(name)
    network = load_reference("dcp", state_of(arrays), **hparams)
    source, target = arrays["source"], arrays["target"]
    with torch.no_grad():
        prediction = network(source, target)
        for side, cloud in (("source", source), ("target", target)):
            close(network.embed(cloud).mT, arrays[f"feature_{side}"], 1e-4)
    close(prediction.correspondence.logits(), arrays["scores"], 1e-4)
    close(prediction.rotation, arrays["rotation_pred"], 1e-4)
    close(prediction.translation, arrays["translation_pred"], 1e-4)
    close(
        correspondence_loss(prediction.correspondence, arrays["correspondence"]),
        arrays["loss_correspondence"],
        1e-5,
    )
    loss = transformation_loss(
        prediction.rotation, prediction.translation, arrays["rotation"], arrays["translation"]
    )
    close(loss, arrays["loss_transformation"], 1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_dcp_training_loss(name):
    arrays, hparams = golden(name)
    loss, _ = loss_and_gradients(arrays, hparams, torch.float32)
    assert loss == pytest.approx(float(arrays["train_loss_correspondence"]), rel=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_dcp_gradients(name):
    """Every gradient within 1e-3 relative, in float64 and up to the sides of ReLU's kinks.

    Some activation lies within rounding of zero, and the side that a float32 pass takes
    decides on up to 0.5 % of a gradient: a literal rewrite of the reference, convolution for
    convolution, differs by as much. So the golden gradient must be the exact one at some
    input within three units in the last place.
    """
    arrays, hparams = golden(name)
    worst = []
    for seed in range(8):
        _, gradients = loss_and_gradients(arrays, hparams, torch.float64, seed)
        worst.append(max(relative(g, arrays[f"grad/{k}"]) for k, g in gradients.items()))
    assert min(worst) < 1e-3, worst
    assert max(worst) < 1e-2, worst


def test_a_zero_gradient_is_zero_here_too():
    """Biases of attention keys shift all logits of a row alike: their gradient is rounding."""
    arrays, hparams = golden("dcp_transformer")
    _, gradients = loss_and_gradients(arrays, hparams, torch.float64)
    keys = [k for k in arrays if k.startswith("grad/") and arrays[k].norm() < 1e-6]
    assert keys
    assert all(
        gradients_of_zero(arrays, hparams)[k.removeprefix("grad/")].norm() < 1e-6 for k in keys
    )
    assert not set(gradients) & {k.removeprefix("grad/") for k in keys}


def test_pretrained_dcp_v1():
    state = torch.load(shared("reference", "dcp_v1.t7"), map_location="cpu", weights_only=True)
    outputs = {
        k: torch.from_numpy(v)
        for k, v in np.load(shared("reference", "dcp_v1_outputs.npz")).items()
    }
    with torch.no_grad():
        prediction = load_reference("dcp", state)(outputs["source"], outputs["target"])
    close(prediction.rotation, outputs["rotation_pred"], 1e-3)
    close(prediction.translation, outputs["translation_pred"], 1e-3)


def as_batch(arrays):
    nothing = torch.zeros(len(arrays["source"]))
    return PairBatch(
        arrays["source"], arrays["target"],
        arrays.get("rotation", nothing), arrays.get("translation", nothing),
        arrays.get("correspondence", nothing), arrays["source"][..., :3], nothing,
    )  # fmt: skip


def worst_gradient(kind, network, arrays):
    """Largest relative error of the network's gradients, those of zero left out."""
    errors = [
        relative(network.get_parameter(rename(kind, name.removeprefix("grad/"))).grad, expected)
        for name, expected in arrays.items()
        if name.startswith("grad/") and expected.norm() > 1e-6
    ]
    assert errors
    return max(errors)


@pytest.mark.parametrize("name", ["rpmnet", "rpmnet_partial"])
def test_rpmnet(name):
    arrays, hparams = golden(name)
    network = load_reference("rpmnet", state_of(arrays), **hparams)
    with torch.no_grad():
        prediction = network(arrays["source"], arrays["target"])
    assert len(prediction.steps) == 2
    for i, step in enumerate(prediction.steps):
        close(step.correspondence.beta, arrays["beta"][i], 1e-4)
        close(step.correspondence.alpha, arrays["alpha"][i], 1e-4)
        close(step.correspondence.prob(), arrays[f"perm_matrix_{i}"], 1e-4)
        moved = torch.cat([step.rotation, step.translation.unsqueeze(-1)], -1)
        close(moved, arrays[f"transform_{i}"], 1e-4)
    batch = as_batch(arrays)
    relative_error = {"rtol": 1e-5, "atol": 0}
    torch.testing.assert_close(
        CorrespondenceLoss().loss(prediction, batch),
        arrays["loss_correspondence"],
        **relative_error,
    )
    torch.testing.assert_close(
        RegistrationLoss().loss(prediction, batch), arrays["loss_rpmnet"], **relative_error
    )


@pytest.mark.parametrize("name", ["rpmnet", "rpmnet_partial"])
def test_rpmnet_gradients(name, monkeypatch):
    """Every gradient within 1e-3 relative, with the reference's own pose between the turns.

    Its float32 pose is 5e-6 off ours, and in `rpmnet` that much decides which point wins a
    maximum of the annealing net in the second turn: 1.4 % of the gradient of its first layers.
    """
    arrays, hparams = golden(name)
    network = load_reference("rpmnet", state_of(arrays), **hparams).train()
    poses = [arrays[f"transform_{i}"] for i in range(2)]
    monkeypatch.setattr(
        rpmnet, "procrustes", lambda *clouds: poses.pop(0).split_with_sizes([3, 1], -1)
    )
    monkeypatch.setattr(rpmnet.rigid, "apply", lambda r, t, x: x @ r.mT + t.view(-1, 1, 3))
    loss = CorrespondenceLoss().loss(network(arrays["source"], arrays["target"]), as_batch(arrays))
    loss.backward()
    assert worst_gradient("rpmnet", network, arrays) < 1e-3


def test_rpmnet_gradients_as_they_are():
    """Without the reference's pose: the partial pair agrees, the full one up to that maximum."""
    for name, tolerance in (("rpmnet_partial", 1e-3), ("rpmnet", 2e-2)):
        arrays, hparams = golden(name)
        network = load_reference("rpmnet", state_of(arrays), **hparams).train()
        prediction = network(arrays["source"], arrays["target"])
        CorrespondenceLoss().loss(prediction, as_batch(arrays)).backward()
        assert worst_gradient("rpmnet", network, arrays) < tolerance


def test_pcrnet():
    arrays, hparams = golden("pcrnet")
    network = load_reference("pcrnet", state_of(arrays), **hparams)
    source, target = arrays["source"], arrays["target"]
    prediction = network(source, target)
    assert len(prediction.steps) == hparams["iterations"]
    close(prediction.rotation, arrays["est_R"], 1e-4)
    close(prediction.translation, arrays["est_t"].squeeze(1), 1e-4)
    close(
        rigid.apply(prediction.rotation, prediction.translation, source),
        arrays["transformed_source"],
        1e-4,
    )
    loss = ChamferLoss().loss(prediction, as_batch(arrays))
    torch.testing.assert_close(loss, arrays["loss_chamfer"], rtol=1e-3, atol=0)
    loss.backward()
    assert worst_gradient("pcrnet", network, arrays) < 1e-3


def float32_pose_error(arrays):
    """How far float32 rounding of the covariance can turn the reference's pose.

    Untrained features match every point with nearly the whole cloud: the covariance has singular
    values of 1e-6, and its rounding, the machine's own, turns the rotation by eps |x| |y| / (s_2
    + s_3). From the reference's own scores, float64 gives a rotation 3e-4 from its float32 one.
    """
    x, y = arrays["source"].double(), arrays["target"].double()
    y_hat = arrays["scores"].double().softmax(-1) @ y
    covariance = (x - x.mean(1, keepdim=True)).mT @ (y_hat - y_hat.mean(1, keepdim=True))
    smallest = torch.linalg.svdvals(covariance / x.shape[1])[:, 1:].sum(1).min()
    rounding = torch.finfo(torch.float32).eps * x.abs().max() * y_hat.abs().max()
    return float(rounding / smallest)


def test_pcrnet_corr():
    arrays, hparams = golden("pcrnet_corr")
    network = load_reference("pcrnet_corr", state_of(arrays), **hparams)
    batch, relative_error = as_batch(arrays), {"rtol": 1e-5, "atol": 0}
    prediction = network(arrays["source"], arrays["target"])
    close(prediction.correspondence.logits(), arrays["scores"], 1e-6)
    close(prediction.rotation, arrays["rotation_pred"], float32_pose_error(arrays))
    close(prediction.translation, arrays["translation_pred"], 1e-4)
    torch.testing.assert_close(
        CorrespondenceLoss().loss(prediction, batch),
        arrays["loss_correspondence"],
        **relative_error,
    )
    network.train()
    loss = CorrespondenceLoss().loss(network(arrays["source"], arrays["target"]), batch)
    torch.testing.assert_close(loss, arrays["train_loss_correspondence"], **relative_error)
    loss.backward()
    assert worst_gradient("pcrnet_corr", network, arrays) < 1e-3


def test_what_does_not_fit_is_listed():
    arrays, hparams = golden("dcp_identity")
    state = state_of(arrays)
    state["emb_nn.conv2.weight"] = state["emb_nn.conv2.weight"][:5]
    del state["emb_nn.bn1.bias"]
    with pytest.raises(
        CorrmatError, match=r"edge\.0\.norm\.bias is missing.*edge\.1\.linear\.weight is \(5, 64\)"
    ):
        load_reference("dcp", state, **hparams)
    for kind in ("dcp", "rpmnet", "pcrnet", "pcrnet_corr"):
        with pytest.raises(CorrmatError, match="^not an? .* checkpoint: .* is missing"):
            load_reference(kind, {"weight": torch.zeros(3)})
    with pytest.raises(CorrmatError, match="no reference network of kind 'pointnetlk'"):
        load_reference("pointnetlk", state)


def test_metrics():
    arrays, _ = golden("metrics")
    rotations = arrays["rotation_pred"], arrays["rotation"]
    close(metrics.rotation_error_deg(*rotations), arrays["geodesic_deg"], 1e-6)
    relative_error = metrics.relative_euler_error_deg(*rotations)
    close(relative_error, arrays["relative_euler_error"].double(), 1e-5)
    close(relative_error.abs().mean(), arrays["relative_euler_mae"].double(), 1e-5)
    close(relative_error.square().mean().sqrt(), arrays["relative_euler_rmse"].double(), 1e-5)
    naive = metrics.naive_euler_error_deg(*rotations)
    close(naive.abs().mean(), arrays["naive_euler_mae"], 1e-6)
    close(naive.square().mean().sqrt(), arrays["naive_euler_rmse"], 1e-6)
    shift = metrics.translation_error(arrays["translation_pred"], arrays["translation"])
    close((shift.square().mean() / 3).sqrt(), arrays["translation_rmse"], 1e-9)


def close(actual, expected, tolerance):
    torch.testing.assert_close(actual, expected, rtol=tolerance, atol=tolerance)


def relative(actual, expected):
    expected = expected.reshape(actual.shape).double()
    return float((actual.double() - expected).norm() / expected.norm())


def loss_and_gradients(arrays, hparams, dtype, seed=None):
    """Training loss and the gradients that the reference has too, zero ones left out.

    With a seed, the input is off by `ULPS`.
    """
    network = load_reference("dcp", state_of(arrays), **hparams).to(dtype).train()
    clouds = [arrays["source"].to(dtype), arrays["target"].to(dtype)]
    if seed is not None:
        noise = torch.Generator().manual_seed(seed)
        clouds = [
            x * (1 + ULPS * torch.randn(x.shape, generator=noise, dtype=dtype)) for x in clouds
        ]
    loss = correspondence_loss(network(*clouds).correspondence, arrays["correspondence"])
    loss.backward()
    names = [
        k.removeprefix("grad/") for k in arrays if k.startswith("grad/") and arrays[k].norm() > 1e-6
    ]
    return loss.item(), {k: network.get_parameter(rename("dcp", k)).grad for k in names}


def gradients_of_zero(arrays, hparams):
    network = load_reference("dcp", state_of(arrays), **hparams).double().train()
    c = network(arrays["source"].double(), arrays["target"].double()).correspondence
    correspondence_loss(c, arrays["correspondence"]).backward()
    names = [k.removeprefix("grad/") for k in arrays if k.startswith("grad/")]
    return {k: network.get_parameter(rename("dcp", k)).grad for k in names}
