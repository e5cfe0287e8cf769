"""Naive twins: the plainest code that computes the same as a fast path."""

import math
from unittest import mock

import torch
import torch.nn.functional as F
from torch import Tensor

from corrmat.networks.attention import StdNorm
from corrmat.networks.dcp import DCPNetwork
from corrmat.networks.pcrnet import PCRNetCorrNetwork, PCRNetwork
from corrmat.networks.ppf import point_pair_features
from corrmat.networks.rpmnet import RPMNetwork


def procrustes_loop(source: Tensor, target: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Kabsch pair by pair, differentiated through the SVD itself."""
    rotations, translations = [], []
    for x, y, w in zip(source, target, weight, strict=True):
        w = w / w.sum()
        cx, cy = (w[:, None] * x).sum(0), (w[:, None] * y).sum(0)
        u, _, vh = torch.linalg.svd((w[:, None] * (x - cx)).T @ (y - cy))
        reflect = torch.diag(torch.stack([w.new_tensor(1.0)] * 2 + [torch.det(vh.T @ u.T).sign()]))
        rotation = vh.T @ reflect @ u.T
        rotations.append(rotation)
        translations.append(cy - rotation @ cx)
    return torch.stack(rotations), torch.stack(translations)


def cross_entropy_by_one_hot(f_x: Tensor, f_y: Tensor, scale: float, index: Tensor) -> Tensor:
    """The paper's L_CE as written: a one-hot matrix against a softmax matrix."""
    c = torch.softmax(scale * f_x @ f_y.mT, -1)
    one_hot = F.one_hot(index, f_y.shape[1]).to(c.dtype)
    return -torch.log((c * one_hot).sum(-1))


def plain_edge_mlp(edges: Tensor, linears, norms) -> list[Tensor]:
    """Linear, batch norm, ReLU, maximum over neighbours: four passes over edges (P, K, C)."""
    pooled = []
    for linear, norm in zip(linears, norms, strict=True):
        edges = F.relu(norm(linear(edges).flatten(0, 1))).view(*edges.shape[:2], -1)
        pooled.append(edges.amax(1))
    return pooled


def neighborhood_net(rows: Tensor, network) -> Tensor:
    """RPMNet's features of neighbourhoods (B, N, K, 10) as written: every layer over all edges."""
    edges = rows.permute(0, 3, 1, 2)
    top = network.edge(edges.flatten(2)).unflatten(2, edges.shape[2:]).amax(3)
    return F.normalize(network.out(network.point(top)).mT, dim=-1)


def attention(x: Tensor, memory: Tensor, layer) -> Tensor:
    """Attention head by head."""
    heads = []
    q, k, v = layer.query(x), layer.key(memory), layer.value(memory)
    size = x.shape[-1] // layer.heads
    for part in (slice(i * size, (i + 1) * size) for i in range(layer.heads)):
        c = torch.softmax(q[..., part] @ k[..., part].mT / math.sqrt(size), -1)
        heads.append(c @ v[..., part])
    return layer.out(torch.cat(heads, -1))


def std_norm(x: Tensor, gain: Tensor, bias: Tensor) -> Tensor:
    """The annotated transformer's LayerNorm, as written."""
    return gain * (x - x.mean(-1, keepdim=True)) / (x.std(-1, keepdim=True) + 1e-6) + bias


def chamfer_loops(
    aligned: Tensor, clean_target: Tensor, target: Tensor, clean_source: Tensor
) -> float:
    """RPMNet's modified Chamfer distance of one pair, point by point."""
    there = [min(float(((x - y) ** 2).sum()) for y in clean_target) for x in aligned]
    back = [min(float(((y - x) ** 2).sum()) for x in clean_source) for y in target]
    return sum(there) / len(there) + sum(back) / len(back)


def sinkhorn_padded(affinity: Tensor, iterations: int, slack: str) -> Tensor:
    """Sinkhorn as written: a padded log matrix, rewritten by every normalisation."""
    row, column = int(slack in ("row", "both")), int(slack == "both")
    a = F.pad(affinity, (0, column, 0, row))
    n, m = affinity.shape[1:]

    def rows(a: Tensor) -> Tensor:
        return torch.cat([a[:, :n] - a[:, :n].logsumexp(2, keepdim=True), a[:, n:]], 1)

    def columns(a: Tensor) -> Tensor:
        return torch.cat([a[:, :, :m] - a[:, :, :m].logsumexp(1, keepdim=True), a[:, :, m:]], 2)

    for _ in range(iterations):
        a = rows(columns(a)) if slack == "row" else columns(rows(a))
    return a[:, :n, :m]


def within_radius_loops(points: Tensor, radius: float, k: int) -> Tensor:
    """Neighbours of lowest index, point by point."""
    neighbors = []
    for cloud in points:
        for i, x in enumerate(cloud):
            near = [j for j, y in enumerate(cloud) if j != i and (x - y).norm() <= radius]
            neighbors.append((near + [i] * k)[:k])
    return torch.tensor(neighbors).view(*points.shape[:2], k)


def chamfer_loss_dense(moved: Tensor, target: Tensor) -> Tensor:
    """The paper's CD over the whole distance matrix."""
    distance = (moved.unsqueeze(2) - target.unsqueeze(1)).norm(dim=-1)
    return distance.amin(2).mean() + distance.amin(1).mean()


def ball_query_by_sorting(points: Tensor, radius: float, k: int) -> Tensor:
    """Neighbours of lowest index from a sorted (B, N, N) array of indices, as released."""
    n = points.shape[1]
    away = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist") > radius
    self_index = torch.arange(n)
    away[:, self_index, self_index] = True
    index = self_index.repeat(len(points), n, 1).masked_fill(away, n).sort(-1).values[..., :k]
    return torch.where(index == n, self_index.view(1, n, 1), index)


def released_dcp(network: DCPNetwork, source: Tensor, target: Tensor) -> tuple[Tensor, ...]:
    """DCP in the released formulation: NCHW edges, whole attention matrices, an SVD a pair."""

    def embed(points: Tensor) -> Tensor:
        net, pooled = network.embed, []
        index = torch.cdist(points, points).topk(net.k, largest=False).indices
        batch = torch.arange(len(points)).view(-1, 1, 1)
        x = torch.cat([points[batch, index], points.unsqueeze(2).expand(-1, -1, net.k, -1)], -1)
        x = x.permute(0, 3, 1, 2).contiguous()
        for layer in net.edge:
            x = norm(F.conv2d(x, layer.linear.weight[..., None, None]), layer.norm)
            pooled.append(x.max(-1, keepdim=True).values)
        fused = norm(F.conv2d(torch.cat(pooled, 1), net.fuse.weight[..., None, None]), net.norm)
        return fused.squeeze(-1).mT

    def norm(x: Tensor, layer: torch.nn.BatchNorm1d) -> Tensor:
        stats = layer.running_mean, layer.running_var
        return F.relu(F.batch_norm(x, *stats, layer.weight, layer.bias, layer.training))

    x, y = source[..., :3], target[..., :3]
    f_x, f_y = embed(x), embed(y)
    with (
        mock.patch.object(F, "scaled_dot_product_attention", whole_attention),
        mock.patch.object(StdNorm, "forward", lambda layer, x: std_norm(x, layer.gain, layer.bias)),
    ):
        pointer = network.pointer or (lambda features, other: features)
        f_x, f_y = f_x + pointer(f_x, f_y), f_y + pointer(f_y, f_x)
    c = torch.softmax(f_x @ f_y.mT / math.sqrt(f_x.shape[-1]), -1)
    return *procrustes_loop(x, c @ y, torch.ones_like(c[..., 0])), c


def whole_attention(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """softmax(Q K^T / sqrt(d)) V, as written."""
    return torch.softmax(q @ k.mT / math.sqrt(q.shape[-1]), -1) @ v


def released_rpmnet(
    network: RPMNetwork, source: Tensor, target: Tensor
) -> tuple[Tensor, Tensor, list[Tensor]]:
    """RPMNet in the released formulation: everything anew for both clouds every turn."""

    def embed(cloud: Tensor, normals: Tensor) -> Tensor:
        index = ball_query_by_sorting(cloud, network.radius, network.k)
        batch = torch.arange(len(cloud)).view(-1, 1, 1)
        offset = cloud[batch, index] - cloud.unsqueeze(2)
        ppf = point_pair_features(offset, normals.unsqueeze(2), normals[batch, index])
        rows = torch.cat([cloud.unsqueeze(2).expand_as(offset), offset, ppf], -1)
        return neighborhood_net(rows, network.embed)

    x, y, matrices = source[..., :3], target[..., :3], []
    rotation, translation = torch.eye(3).expand(len(x), 3, 3).to(x), torch.zeros(len(x), 3).to(x)
    for _ in range(network.iterations if network.training else network.test_iterations):
        rotation, translation = rotation.detach(), translation.detach()
        moved = x @ rotation.mT + translation.unsqueeze(1)
        f_x = embed(moved, source[..., 3:] @ rotation.mT)
        f_y = embed(y, target[..., 3:])
        beta, alpha = network.annealing(moved, y)
        affinity = -beta[:, None, None] * (square_distance(f_x, f_y) - alpha[:, None, None])
        c = sinkhorn_padded(affinity, network.sinkhorn_iterations, network.slack).exp()
        weight = c.sum(2)
        matched = c @ y / weight.unsqueeze(2)
        rotation, translation = procrustes_loop(x, matched, weight)
        matrices.append(c)
    return rotation, translation, matrices


def pair_features_as_written(offset: Tensor, n: Tensor, m: Tensor) -> Tensor:
    """Signless pair features by their formula, coordinates last: (..., 13)."""
    distance = offset.norm(dim=-1).clamp_min(1e-6)
    d = offset / distance.unsqueeze(-1)
    a, b, c = (n * d).sum(-1), (m * d).sum(-1), (n * m).sum(-1)
    triple = (torch.linalg.cross(*torch.broadcast_tensors(n, m)) * d).sum(-1)
    bumps = [
        torch.exp(-(((distance / centre).log() / 0.45) ** 2))
        for centre in (0.05, 0.1, 0.17, 0.27, 0.42, 0.65, 1.0, 1.6)
    ]
    return torch.stack([*bumps, a.abs(), b.abs(), c.abs(), a * b * c, triple * c], -1)


def square_distance(x: Tensor, y: Tensor) -> Tensor:
    """|x_i - y_j|^2 of (B, N, d) and (B, M, d), by products: no (B, N, M, d) array."""
    return x.square().sum(2, keepdim=True) - 2 * x @ y.mT + y.square().sum(2).unsqueeze(1)


def one_hot_loss(c: Tensor, match: Tensor) -> Tensor:
    """The cross-entropy of matrices (B, N, M) against one-hot matrices."""
    labels = F.one_hot(match, c.shape[2]).to(c.dtype)
    return -(labels * torch.log(c + 1e-30)).sum(2).mean()


def pointnet(points: Tensor, network: torch.nn.Module) -> Tensor:
    """PointNet as 1 x 1 convolutions over (B, 3, N), layer by layer: (B, N, width)."""
    x = points.mT
    for layer in network.layers:
        match layer:
            case torch.nn.Linear():
                x = F.conv1d(x, layer.weight.unsqueeze(-1), layer.bias)
            case torch.nn.BatchNorm1d():
                x = batch_norm(x, layer)
            case _:
                x = F.relu(x)
    return x.mT


def batch_norm(x: Tensor, layer: torch.nn.BatchNorm1d) -> Tensor:
    """Batch norm of (B, C, ...); running statistics are not updated."""
    stats = (None, None) if layer.training else (layer.running_mean, layer.running_var)
    return F.batch_norm(x, *stats, layer.weight, layer.bias, layer.training, eps=layer.eps)


def released_pcrnet(network: PCRNetwork, source: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """PCRNet in the released formulation: 4 x 4 transforms, one pose after the other."""
    x, y = source[..., :3], target[..., :3]
    centre_x, centre_y = x.mean(1), y.mean(1)
    moved, template = x - centre_x.unsqueeze(1), y - centre_y.unsqueeze(1)
    f_y = pointnet(template, network.embed).amax(1)
    total = torch.eye(4).to(x).repeat(len(x), 1, 1)
    for _ in range(network.iterations):
        out = torch.cat([f_y, pointnet(moved, network.embed).amax(1)], 1)
        for layer in network.pose:
            out = layer(out)
        rotation = torch.stack([rotation_of_quaternion(q / q.norm()) for q in out[:, :4]])
        moved = moved @ rotation.mT + out[:, None, 4:]
        bottom = torch.tensor([0.0, 0, 0, 1]).to(x).expand(len(x), 1, 4)
        total = torch.cat([torch.cat([rotation, out[:, 4:, None]], 2), bottom], 1) @ total
    rotation, shift = total[:, :3, :3], total[:, :3, 3]
    return rotation, shift + centre_y - (rotation @ centre_x.unsqueeze(2)).squeeze(2)


def rotation_of_quaternion(q: Tensor) -> Tensor:
    """R = (w^2 - v.v) I + 2 v v^T + 2 w [v]_x of a unit quaternion (w, v)."""
    w, v = q[0], q[1:]
    cross = torch.linalg.cross(v.expand(3, 3), torch.eye(3).to(q)).mT
    return (w * w - v @ v) * torch.eye(3).to(q) + 2 * torch.outer(v, v) + 2 * w * cross


def released_pcrnet_corr(
    network: PCRNetCorrNetwork, source: Tensor, target: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """PCRNet_corr in the released formulation: convolutions, a whole softmax, an SVD a pair."""
    x, y = source[..., :3], target[..., :3]
    f_x, f_y = pointnet(x, network.embed), pointnet(y, network.embed)
    c = torch.softmax(f_x @ f_y.mT / math.sqrt(f_x.shape[-1]), -1)
    return *procrustes_loop(x, c @ y, torch.ones_like(c[..., 0])), c
