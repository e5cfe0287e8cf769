import pytest
import torch
from twins import PlainNormLinear, attention, std_norm

from corrmat.methods import DCP, METHODS, DCPCorr
from corrmat.networks.attention import Attention, StdNorm, Transformer
from corrmat.networks.dcp import DCPNetwork
from corrmat.networks.dgcnn import DGCNN, FoldedNormLinear, edge_features
from corrmat.ops.neighbors import knn


def small(pointer="transformer"):
    torch.manual_seed(0)
    return DCPNetwork(16, pointer, 2, 16, (8, 8, 12, 16), 5)


@pytest.mark.parametrize("mode", ["train", "eval"])
def test_folded_norm_equals_the_plain_layer(mode, generator):
    """Values, every gradient, and the running statistics that training leaves behind."""
    found = []
    for kind in (FoldedNormLinear, PlainNormLinear):
        torch.manual_seed(1)
        layer = kind(6, 10).double()
        layer.norm.weight.data = torch.linspace(-1, 2, 10, dtype=torch.float64)
        layer.norm.bias.data = torch.linspace(-0.5, 0.5, 10, dtype=torch.float64)
        layer(
            torch.randn(4, 30, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
            + 1
        )
        layer.train(mode == "train")
        rows = torch.randn(
            4, 30, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(3)
        )
        rows.requires_grad_()
        out, top = layer(rows)
        pull = torch.randn(
            out.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(4)
        )
        ((out * pull).sum() + (top * pull[0]).sum()).backward()
        stats = [layer.norm.running_mean, layer.norm.running_var, layer.norm.num_batches_tracked]
        found.append([out, top, rows.grad, *(p.grad for p in layer.parameters()), *stats])
    for fast, naive in zip(*found, strict=True):
        torch.testing.assert_close(fast, naive, rtol=1e-9, atol=1e-10)


def test_ties_give_their_gradient_once():
    """Two equal neighbours: the maximum's gradient goes to one of them, not to both."""
    torch.manual_seed(0)
    layer = FoldedNormLinear(3, 4).double().eval()
    rows = torch.randn(1, 6, 3, dtype=torch.float64).expand(2, -1, -1).clone().requires_grad_()
    layer(rows)[1].sum().backward()
    assert (rows.grad[1] == 0).all()
    assert (rows.grad[0] != 0).any()


def test_edges_are_neighbour_then_centre(generator):
    points = torch.randn(2, 6, 3, generator=generator)
    neighbors = knn(points, 3)
    assert torch.equal(neighbors[..., 0], torch.arange(6).expand(2, -1))  # itself is nearest
    edges = edge_features(points, neighbors).view(3, 2, 6, 6)
    assert torch.equal(edges[2, 1, 4], torch.cat([points[1, neighbors[1, 4, 2]], points[1, 4]]))


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
