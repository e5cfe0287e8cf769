import pytest
import torch
from twins import (
    PlainEdgeConvolution,
    attention,
    neighborhood_net,
    one_hot_loss,
    released_dcp,
    released_rpmnet,
    std_norm,
)

from corrmat.losses import correspondence_loss
from corrmat.methods import DCP, METHODS, DCPCorr
from corrmat.networks import edges
from corrmat.networks.attention import Attention, StdNorm, Transformer
from corrmat.networks.dcp import DCPNetwork
from corrmat.networks.dgcnn import DGCNN, EdgeConvolution, edge_features
from corrmat.networks.edges import moments
from corrmat.networks.ppf import neighborhoods
from corrmat.networks.rpmnet import NeighborhoodNet
from corrmat.ops.neighbors import knn
from corrmat.types import PairBatch

TINY = {
    "DCP": {"width": 32, "feedforward": 32, "edge_channels": (8, 8, 12, 16), "k": 5},
    "RPMNet": {"width": 16, "k": 6, "radius": 1.5, "annealing_width": 16},
    "PCRNet": {"width": 32},
    "Invariant": {"width": 32, "layers": 1, "anchors": 8, "neighbors": 4},
}
STATISTICS = ("running_mean", "running_var", "num_batches_tracked")


def small(pointer="transformer"):
    torch.manual_seed(0)
    return DCPNetwork(16, pointer, 2, 16, (8, 8, 12, 16), 5)


@pytest.mark.parametrize("mode", ["train", "eval"])
@pytest.mark.parametrize("last", [False, True])
def test_folded_batch_norm_equals_the_plain_layer(mode, last):
    """Values, every gradient, and the running statistics that training leaves behind."""

    def draw(seed, *shape):
        chance = torch.Generator().manual_seed(seed)
        return torch.randn(*shape, dtype=torch.float64, generator=chance)

    found = []
    for kind in (EdgeConvolution, PlainEdgeConvolution):
        torch.manual_seed(1)
        layers = [kind(6, 10).double(), kind(10, 5).double()]
        for layer in layers:
            layer.norm.weight.data = torch.linspace(-1, 2, len(layer.norm.weight)).double()
            layer.norm.bias.data = torch.linspace(-0.5, 0.5, len(layer.norm.bias)).double()
        rows = (draw(2, 1, 30, 4, 6) + 1).requires_grad_()
        first = layers[0](rows, moments(rows))
        layers[1](first.rows, first.moments)  # leaves running statistics
        for layer in layers:
            layer.train(mode == "train")
        seen = moments(rows) if mode == "train" else None
        first = layers[0](rows, seen)
        second = layers[1](first.rows, first.moments, last=last)
        value = (first.top * draw(3, 1, 30, 10)).sum() + (second.top * draw(4, 1, 30, 5)).sum()
        if not last:
            value = value + (second.rows * draw(5, 1, 30, 4, 5)).sum()
        value.backward()
        stats = [getattr(layer.norm, name) for layer in layers for name in STATISTICS]
        grads = [p.grad for layer in layers for p in layer.parameters()]
        found.append([first.rows, first.top, second.top, rows.grad, *grads, *stats])
    for fast, naive in zip(*found, strict=True):
        torch.testing.assert_close(fast, naive, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("slab", [1, 7, 8192])
def test_folded_group_norm_equals_the_plain_network(slab, monkeypatch, generator):
    """Values and gradients, however the edges are cut into slabs."""
    monkeypatch.setattr(edges, "_ROWS", slab)
    torch.manual_seed(0)
    network = NeighborhoodNet(16).double()
    cloud = torch.randn(2, 9, 6, dtype=torch.float64, generator=generator)
    around = neighborhoods(cloud, 1.5, 5)
    pull = torch.randn(2, 9, 16, dtype=torch.float64, generator=generator)
    found = []
    for value in (network(around), neighborhood_net(around.features(), network)):
        network.zero_grad()
        (value * pull).sum().backward()
        found.append([value, *(p.grad.clone() for p in network.parameters())])
    for fast, naive in zip(*found, strict=True):
        torch.testing.assert_close(fast, naive, rtol=1e-8, atol=1e-9)


def test_ties_give_their_gradient_once():
    """Two equal neighbours: the maximum's gradient goes to one of them, not to both."""
    torch.manual_seed(0)
    layer = EdgeConvolution(3, 4).double().eval()
    rows = torch.randn(1, 6, 1, 3, dtype=torch.float64).expand(-1, -1, 2, -1).clone()
    layer(rows.requires_grad_(), None).top.sum().backward()
    given = (rows.grad != 0).any(-1)
    assert given.any(-1).any()
    assert not given.all(-1).any()


def test_edges_are_neighbour_then_centre(generator):
    points = torch.randn(2, 6, 3, generator=generator)
    neighbors = knn(points, 3)
    assert torch.equal(neighbors[..., 0], torch.arange(6).expand(2, -1))  # itself is nearest
    rows = edge_features(points, neighbors).view(2, 6, 3, 6)
    assert torch.equal(rows[1, 4, 2], torch.cat([points[1, neighbors[1, 4, 2]], points[1, 4]]))


def test_knn_of_too_small_a_cloud_says_so():
    with pytest.raises(ValueError, match="20 neighbours asked of a cloud with 8 points"):
        knn(torch.zeros(1, 8, 3), 20)


def test_attention_and_norm_equal_their_twins(generator):
    layer = Attention(12, 3).double()
    x, memory = torch.randn(2, 2, 7, 12, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(layer(x, memory), attention(x, memory, layer))
    norm = StdNorm(12).double()
    norm.gain.data = torch.linspace(0.5, 2, 12, dtype=torch.float64)
    torch.testing.assert_close(norm(x), std_norm(x, norm.gain, norm.bias), rtol=1e-5, atol=1e-5)


def test_a_constant_row_is_normed_to_the_bias():
    norm = StdNorm(8)
    norm.bias.data.fill_(0.5)
    assert torch.equal(norm(torch.ones(1, 8)), torch.full((1, 8), 0.5))


@pytest.mark.parametrize("pointer", ["transformer", "identity"])
def test_dcp_shapes_and_finite_gradients(pointer, generator):
    network = small(pointer).train()
    source, target = (
        torch.randn(3, 11, 6, generator=generator),
        torch.randn(3, 14, 6, generator=generator),
    )
    prediction = network(source, target)
    assert prediction.rotation.shape == (3, 3, 3)
    assert prediction.translation.shape == (3, 3)
    assert prediction.correspondence.logits().shape == (3, 11, 14)
    assert prediction.steps == [prediction]
    (
        prediction.rotation.sum() + prediction.correspondence.nll(torch.zeros(3, 11).long()).sum()
    ).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in network.parameters())


@pytest.mark.parametrize("kind", ["DCP", "RPMNet"])
def test_networks_equal_the_released_formulation(kind, generator):
    """Pose, loss and gradients of the code that `make bench` is measured against."""
    torch.manual_seed(0)
    network = METHODS[kind].network_type(**TINY[kind]).double().train()
    target = torch.randn(2, 14, 6, dtype=torch.float64, generator=generator)
    target[..., 3:] /= target[..., 3:].norm(dim=-1, keepdim=True)
    source, match = target[:, :12], torch.arange(12).expand(2, -1)
    found = network(source, target)
    if kind == "DCP":
        loss = correspondence_loss(found.correspondence, match)
        rotation, _, c = released_dcp(network, source, target)
        released = one_hot_loss(c, match)
    else:
        loss = sum(correspondence_loss(step.correspondence, match) for step in found.steps)
        rotation, _, matrices = released_rpmnet(network, source, target)
        released = sum(one_hot_loss(c, match) for c in matrices)
    torch.testing.assert_close(rotation, found.rotation, rtol=1e-6, atol=1e-7)
    grads = []
    for value in (loss, released):
        network.zero_grad()
        value.backward()
        grads.append([p.grad.clone() for p in network.parameters() if p.grad is not None])
    torch.testing.assert_close(released, loss)
    for ours, theirs in zip(*grads, strict=True):
        torch.testing.assert_close(theirs, ours, rtol=1e-5, atol=1e-7)


def test_dcp_does_not_care_for_the_order_of_points(generator):
    network = small().eval()
    source, target = torch.randn(2, 1, 12, 3, generator=generator)
    there, back = torch.randperm(12, generator=generator), torch.randperm(12, generator=generator)
    with torch.no_grad():
        before, after = network(source, target), network(source[:, there], target[:, back])
    torch.testing.assert_close(after.rotation, before.rotation, atol=1e-4, rtol=1e-4)
    logits = before.correspondence.logits()[:, there][:, :, back]
    torch.testing.assert_close(after.correspondence.logits(), logits, atol=1e-4, rtol=1e-4)


def test_dcp_runs_in_bfloat16_autocast(generator):
    network = small().train()
    source = torch.randn(2, 12, 3, generator=generator)
    with torch.autocast("cpu", torch.bfloat16):
        prediction = network(source, source)
        prediction.correspondence.nll(torch.zeros(2, 12).long()).mean().backward()
    assert prediction.rotation.dtype == torch.float32
    assert all(p.grad.isfinite().all() for p in network.parameters())


def test_the_papers_network_has_its_size():
    assert round(sum(p.numel() for p in DCPCorr().parameters()) / 1e6, 2) == 5.57
    assert isinstance(DCP().network.pointer, Transformer)
    assert DGCNN().k == 20
    assert DCP().optimizer.lr == 1e-3
    assert set(METHODS) >= {"DCP", "DCP_corr"}


@pytest.mark.parametrize("name", sorted(METHODS))
def test_a_step_in_bfloat16_is_near_the_one_in_float32(name, generator):
    """What must be exact stays in float32: the loss agrees as far as bfloat16 features do."""
    torch.manual_seed(0)
    method = METHODS[name](METHODS[name].network_type(**TINY[name.removesuffix("_corr")]))
    method.log = lambda *args, **options: None
    target = torch.randn(2, 24, 6, generator=generator)
    target[..., 3:] /= target[..., 3:].norm(dim=-1, keepdim=True)
    rotation = torch.eye(3).expand(2, -1, -1)
    match = torch.arange(20).expand(2, -1)
    source = target[:, :20]
    batch = PairBatch(
        source, target, rotation, torch.zeros(2, 3), match, source[..., :3], torch.zeros(2).long()
    )
    exact = method.training_step(batch, 0)
    with torch.autocast("cpu", torch.bfloat16):
        rough = method.training_step(batch, 0)
    rough.backward()
    assert rough.dtype == torch.float32
    torch.testing.assert_close(rough, exact, rtol=0.05, atol=0.02)
    assert all(p.grad is None or p.grad.isfinite().all() for p in method.parameters())
