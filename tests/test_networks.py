import copy
import functools

import pytest
import torch
from torch import nn
from twins import (
    attention,
    neighborhood_net,
    plain_edge_mlp,
    std_norm,
)

from corrmat.errors import CorrmatError
from corrmat.methods import DCP, METHODS, DCPCorr
from corrmat.networks.attention import Attention, StdNorm, Transformer
from corrmat.networks.dcp import DCPNetwork
from corrmat.networks.dgcnn import DGCNN, EdgeConvolution, edge_features
from corrmat.networks.invariant import InvariantNetwork
from corrmat.networks.pointnet import shared_mlp
from corrmat.networks.ppf import neighborhoods
from corrmat.networks.rpmnet import NeighborhoodNet, RPMNetwork
from corrmat.ops import edge_mlp
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


@pytest.mark.parametrize("training", [True, False])
def test_the_fused_edge_mlp_equals_the_plain_layers(training):
    """Values, every gradient, and the running statistics that training leaves behind."""

    def draw(seed, *shape):
        random = torch.Generator().manual_seed(seed)
        return torch.randn(*shape, dtype=torch.float64, generator=random)

    results = []
    for mlp in (functools.partial(edge_mlp.batch_norm_edge_mlp, training=training), plain_edge_mlp):
        torch.manual_seed(1)
        layers = [EdgeConvolution(6, 10).double(), EdgeConvolution(10, 5).double()]
        for layer in layers:
            layer.norm.weight.data = torch.linspace(-1, 2, len(layer.norm.weight)).double()
            layer.norm.bias.data = torch.linspace(-0.5, 0.5, len(layer.norm.bias)).double()
            layer.norm.running_mean.fill_(0.1)
            layer.train(training)
        edges = (draw(2, 30, 4, 6) + 1).requires_grad_()
        pooled = mlp(edges, [la.linear for la in layers], [la.norm for la in layers])
        (sum((p * draw(3 + i, *p.shape)).sum() for i, p in enumerate(pooled))).backward()
        statistics = [getattr(layer.norm, name) for layer in layers for name in STATISTICS]
        gradients = [p.grad for layer in layers for p in layer.parameters()]
        results.append([*pooled, edges.grad, *gradients, *statistics])
    for fused, plain in zip(*results, strict=True):
        torch.testing.assert_close(fused, plain, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("frozen", [False, True])
def test_dgcnn_gives_the_same_with_and_without_the_fused_kernel(monkeypatch, generator, frozen):
    """In training too, and where only the statistics of its norms are frozen."""
    torch.manual_seed(0)
    network = DGCNN(16, (8, 8, 12, 16), 5).double()
    for norm in (network.norm, *(layer.norm for layer in network.edge)):
        norm.train(not frozen)
        norm.running_mean.fill_(0.1)
    points = torch.randn(2, 30, 3, dtype=torch.float64, generator=generator)
    results = []
    for fewest in (0, 10**9):
        monkeypatch.setattr(edge_mlp, "_MIN_EDGES", fewest)
        network.zero_grad()
        features = network(points)
        features.square().sum().backward()
        results.append([features, *(p.grad.clone() for p in network.parameters())])
    for fused, plain in zip(*results, strict=True):
        torch.testing.assert_close(fused, plain, rtol=1e-8, atol=1e-9)


def test_one_cloud_may_take_the_fused_kernel_and_the_other_not(monkeypatch, generator):
    """A cropped source has fewer edges than its target."""
    torch.manual_seed(0)
    network = DGCNN(16, (8, 8, 12, 16), 5).double()
    source, target = (
        torch.randn(2, n, 3, dtype=torch.float64, generator=generator) for n in (20, 30)
    )
    start, results = copy.deepcopy(network.state_dict()), []
    for fewest in (2 * 25 * 5, 10**9):
        monkeypatch.setattr(edge_mlp, "_MIN_EDGES", fewest)
        network.load_state_dict(start)
        network.zero_grad()
        (network(source).square().sum() + network(target).square().sum()).backward()
        gradients = [p.grad.clone() for p in network.parameters()]
        results.append([*gradients, *map(torch.clone, network.buffers())])
    for mixed, plain in zip(*results, strict=True):
        torch.testing.assert_close(mixed, plain, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("slab", [1, 700, 2**20])
def test_folded_group_norm_equals_the_plain_network(slab, monkeypatch, generator):
    """Values and gradients, however the edges are cut into slabs."""
    monkeypatch.setattr(edge_mlp, "_SLAB_VALUES", slab)
    monkeypatch.setattr(edge_mlp, "_MIN_ROWS", 0)
    torch.manual_seed(0)
    network = NeighborhoodNet(16).double()
    for norm in network.edge[1::3]:
        norm.weight.data = torch.linspace(-1, 2, len(norm.weight)).double()
        norm.bias.data = torch.linspace(-0.5, 0.5, len(norm.bias)).double()
    cloud = torch.randn(2, 9, 6, dtype=torch.float64, generator=generator)
    local = neighborhoods(cloud, 1.5, 5)
    pull = torch.randn(2, 9, 16, dtype=torch.float64, generator=generator)
    results = []
    for value in (network(local), neighborhood_net(local.features(), network)):
        network.zero_grad()
        (value * pull).sum().backward()
        results.append([value, *(p.grad.clone() for p in network.parameters())])
    for fast, naive in zip(*results, strict=True):
        torch.testing.assert_close(fast, naive, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("slab", [1, 100, 2**20])
def test_the_maximum_of_a_linear_layer_equals_the_plain_one(slab, monkeypatch, generator):
    monkeypatch.setattr(edge_mlp, "_SLAB_VALUES", slab)
    torch.manual_seed(0)
    linear = torch.nn.Linear(6, 11).double()
    rows = torch.randn(3, 20, 6, dtype=torch.float64, generator=generator).requires_grad_()
    pull = torch.randn(3, 11, dtype=torch.float64, generator=generator)
    results = []
    for value in (edge_mlp.linear_max(rows, linear), linear(rows).amax(1)):
        leaves = (rows, linear.weight, linear.bias)
        results.append([value, *torch.autograd.grad((value * pull).sum(), leaves)])
    for fast, naive in zip(*results, strict=True):
        torch.testing.assert_close(fast, naive, rtol=1e-12, atol=1e-12)


def test_ties_give_their_gradient_once():
    """Two equal neighbours: the maximum's gradient goes to one of them, not to both."""
    torch.manual_seed(0)
    layer = EdgeConvolution(3, 4).double().eval()
    edges = torch.randn(6, 1, 3, dtype=torch.float64).expand(-1, 2, -1).clone().requires_grad_()
    (pooled,) = edge_mlp.batch_norm_edge_mlp(edges, [layer.linear], [layer.norm], training=False)
    pooled.sum().backward()
    given = (edges.grad != 0).any(-1)
    assert given.any(-1).any()
    assert not given.all(-1).any()


def test_edges_are_neighbour_then_centre(generator):
    points = torch.randn(2, 6, 3, generator=generator)
    neighbors = knn(points, 3)
    assert torch.equal(neighbors[..., 0], torch.arange(6).expand(2, -1))  # itself is nearest
    rows = edge_features(points, neighbors)
    assert torch.equal(rows[1, 4, 2], torch.cat([points[1, neighbors[1, 4, 2]], points[1, 4]]))


def test_knn_of_too_small_a_cloud_says_so():
    with pytest.raises(ValueError, match="20 neighbours asked of a cloud with 8 points"):
        knn(torch.zeros(1, 8, 3), 20)


def test_attention_and_norm_equal_their_twins(generator):
    layer = Attention(12, 3).double()
    x, memory = torch.randn(2, 2, 7, 12, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(layer(x, memory), attention(x, memory, layer))
    with torch.autocast("cpu", torch.bfloat16):
        half = layer.float()(x.float(), memory.float())
    exact = attention(x, memory, layer.double())
    torch.testing.assert_close(half.double(), exact, atol=0.02, rtol=0.05)
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
    assert DCP().optimizer_settings.lr == 1e-3
    assert set(METHODS) >= {"DCP", "DCP_corr"}


@pytest.mark.parametrize("name", sorted(METHODS))
def test_a_step_in_bfloat16_is_near_the_one_in_float32(name, generator):
    """What must be exact stays in float32: the loss agrees as far as bfloat16 features do."""
    torch.manual_seed(0)
    method = METHODS[name](TINY[name.removesuffix("_corr")])
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


def test_the_maximum_over_very_many_points_has_its_gradient():
    """Winners do not fit into 16 bits here."""
    torch.manual_seed(0)
    layers = shared_mlp((3, 8, 8), functools.partial(nn.GroupNorm, 2))
    edges = torch.randn(1, 1, 40_000, 3, requires_grad=True)
    fused = edge_mlp.group_norm_edge_mlp(edges, layers)
    (grad,) = torch.autograd.grad(fused.sum(), edges)
    plain = layers(edges.flatten(1, 2).mT).amax(2).unsqueeze(1)
    torch.testing.assert_close(fused, plain, rtol=1e-4, atol=1e-5)
    (expected,) = torch.autograd.grad(plain.sum(), edges)
    torch.testing.assert_close(grad, expected, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize(
    ("network", "option", "value"),
    [
        (InvariantNetwork, "layers", -1),
        (InvariantNetwork, "shares", ()),
        (InvariantNetwork, "shares", (0.1, 2.0)),
        (RPMNetwork, "radius", -1.0),
    ],
)
def test_options_that_make_no_network_are_refused(network, option, value):
    with pytest.raises(CorrmatError, match=option):
        network(**{option: value})
