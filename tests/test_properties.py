"""What holds for any input: rigid motions, correspondence, metrics, pairs, readers of files."""

import contextlib
import io
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from corrmat import metrics
from corrmat.data.clouds import CloudSet
from corrmat.data.pairs import Key, PairSettings, make_pairs
from corrmat.data.scans import read_scan
from corrmat.errors import CorrmatError
from corrmat.ops import rigid
from corrmat.ops.correspondence import MatchabilityCorrespondence, SoftCorrespondence
from corrmat.registration.preparation import Cloud
from corrmat.registration.register import register

settings.register_profile(
    "corrmat", deadline=None, suppress_health_check=list(HealthCheck), derandomize=True
)
settings.load_profile("corrmat")

seeds = st.integers(0, 2**32 - 1)
sizes = st.integers(1, 40)
dtypes = st.sampled_from([torch.float32, torch.float64])


def motion(generator, batch, dtype=torch.float64):
    axis = torch.nn.functional.normalize(
        torch.randn(batch, 3, generator=generator, dtype=torch.float64), dim=-1
    )
    angle = 2 * torch.pi * torch.rand(batch, generator=generator, dtype=torch.float64)
    shift = torch.randn(batch, 3, generator=generator, dtype=torch.float64)
    return rigid.axis_angle_to_matrix(axis, angle).to(dtype), shift.to(dtype)


@given(seeds, sizes)
def test_composed_transforms_move_as_both_do(seed, n):
    generator = torch.Generator().manual_seed(seed)
    one, two = motion(generator, 2), motion(generator, 2)
    x = torch.randn(2, n, 3, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(
        rigid.apply(*rigid.compose(one, two), x), rigid.apply(*one, rigid.apply(*two, x))
    )


@given(seeds, st.integers(0, 12), dtypes, st.sampled_from(["any", "line", "plane", "point"]))
def test_procrustes_is_a_proper_rotation_whatever_it_gets(seed, n, dtype, kind):
    """Degenerate clouds too; where the points determine it, it is the motion."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(2, n, 3, generator=generator, dtype=dtype)
    x = x * torch.tensor(
        {"any": [1, 1, 1], "plane": [1, 1, 0], "line": [1, 0, 0], "point": [0, 0, 0]}[kind]
    )
    true = motion(generator, 2, dtype)
    y = rigid.apply(*true, x).requires_grad_()
    weight = torch.rand(2, n, generator=generator, dtype=dtype)
    rotation, translation = rigid.procrustes(x, y, weight)
    eye = torch.eye(3, dtype=dtype).expand(2, 3, 3)
    torch.testing.assert_close(rotation @ rotation.mT, eye, atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.det(rotation), torch.ones(2, dtype=dtype), atol=1e-5, rtol=0)
    if n:
        moved = rigid.apply(rotation, translation, x)
        torch.testing.assert_close(moved, y, atol=2e-3, rtol=0)
        (rotation.sum() + translation.sum()).backward()
        assert y.grad.isfinite().all()


@given(seeds, sizes, sizes, st.integers(1, 8), dtypes, st.booleans(), st.floats(0, 100))
def test_rows_are_distributions_and_answers_agree_with_them(seed, n, m, d, dtype, outlier, size):
    generator = torch.Generator().manual_seed(seed)
    f_x, f_y = (size * torch.randn(2, k, d, generator=generator, dtype=dtype) for k in (n, m))
    last = torch.randn(2, n, generator=generator, dtype=dtype) if outlier else None
    c = SoftCorrespondence(f_x, f_y, d**-0.5, last)
    prob = c.prob()
    assert prob.shape == (2, n, m + outlier)
    torch.testing.assert_close(prob.sum(-1), torch.ones(2, n, dtype=dtype))
    assert (prob.gather(2, c.argmax().unsqueeze(-1)).squeeze(-1) >= prob.amax(-1) - 1e-5).all()
    y = torch.randn(2, m, 3, generator=generator, dtype=dtype)
    actual, low, high = c.soft_target(y), y.amin(1, True), y.amax(1, True)
    held = c.weight() > 1e-3
    assert ((actual >= low - 1e-3) & (actual <= high + 1e-3))[held].all()
    index = torch.randint(-1, m + 1, (2, n), generator=generator)
    nll = c.nll(index)
    assert (nll >= -1e-4 * (1 + size**2)).all()
    assert (nll[~c.is_class(index)] == 0).all()


@given(seeds, sizes, sizes)
def test_doubly_normalised_matrices_have_rows_and_columns_of_at_most_one(seed, n, m):
    generator = torch.Generator().manual_seed(seed)
    f_x, f_y, m_x, m_y = (
        torch.randn(1, *s, generator=generator) for s in ((n, 4), (m, 4), (n,), (m,))
    )
    prob = MatchabilityCorrespondence(f_x, f_y, 0.5, m_x, m_y).prob()
    assert (prob.sum(2) <= 1 + 1e-5).all()
    assert (prob[..., :m].sum(1) <= 1 + 1e-5).all()


@given(seeds)
def test_metrics_are_zero_for_the_truth_and_do_not_depend_on_the_frame(seed):
    generator = torch.Generator().manual_seed(seed)
    (r, _), (true_r, true_t) = motion(generator, 4), motion(generator, 4)
    assert metrics.rotation_error_deg(true_r, true_r).max() < 1e-5
    assert metrics.translation_error(true_t, true_t).max() == 0
    error = metrics.rotation_error_deg(r, true_r)
    assert ((error >= 0) & (error <= 180)).all()
    turn, _ = motion(generator, 4)
    torch.testing.assert_close(
        metrics.rotation_error_deg(turn @ r, turn @ true_r), error, atol=1e-5, rtol=0
    )
    torch.testing.assert_close(metrics.rotation_error_deg(true_r, r), error, atol=1e-5, rtol=0)


@given(
    seeds,
    st.integers(3, 40),
    st.floats(0.5, 1.0),
    st.sampled_from(["identical", "independent", "disjoint"]),
    st.floats(0, 0.3),
    st.sampled_from(["source", "both"]),
    st.floats(0, 180),
)
def test_pairs_are_what_their_settings_say(seed, n, keep, sampling, outliers, corrupted, degrees):
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(2, 80, 6)).astype(np.float32) / 4
    clouds = CloudSet(rows, np.zeros(2, np.int64), ("thing",))
    try:
        settings = PairSettings(
            n, degrees, keep=keep, sampling=sampling, outliers=outliers, corrupted=corrupted
        )
    except CorrmatError:
        assert round(keep * n) < 3
        return
    keys = [Key(seed, 0, 0, i) for i in range(2)]
    pairs, again = (make_pairs(clouds, range(2), keys, settings) for _ in range(2))
    assert torch.equal(pairs.source, again.source)
    assert pairs.source.shape[1] == round(keep * n)
    assert pairs.target.shape[1] == (round(keep * n) if corrupted == "both" else n)
    assert ((pairs.match >= 0) & (pairs.match <= pairs.target.shape[1])).all()
    eye = torch.eye(3).expand(2, 3, 3)
    torch.testing.assert_close(pairs.rotation @ pairs.rotation.mT, eye, atol=1e-5, rtol=0)
    assert (metrics.rotation_error_deg(pairs.rotation, eye) <= degrees + 1e-2).all()
    matched = pairs.match < pairs.target.shape[1]
    moved = rigid.apply(pairs.rotation, pairs.translation, pairs.source[..., :3])
    nearest = torch.cdist(moved.double(), pairs.target[..., :3].double())
    at = nearest.gather(2, pairs.match.clamp_max(pairs.target.shape[1] - 1).unsqueeze(-1))
    assert (at.squeeze(-1) <= nearest.amin(2) + 1e-4)[matched].all()


@given(seeds, st.integers(0, 60), st.sampled_from([1e-6, 1.0, 1e9]), st.floats(-1e7, 1e7))
@settings(max_examples=60)
def test_registration_gives_a_rigid_motion_or_the_projects_own_error(seed, n, scale, far):
    rng = np.random.default_rng(seed)
    cloud = scale * (rng.normal(size=(n, 3)) * rng.choice([0.0, 1.0, 1.0], 3) + far)
    try:
        result = register(cloud, cloud[::-1], model="icp")
    except CorrmatError:
        return
    assert np.isfinite(result.transform).all()
    rotation = result.transform[:3, :3]
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(rotation) > 0
    assert 0 <= result.confidence <= 1


@given(seeds, st.integers(3, 200))
def test_the_order_of_a_cloud_is_its_own(seed, n):
    rng = np.random.default_rng(seed)
    cloud = rng.normal(size=(n, 3))
    order = rng.permutation(n)
    one, two = Cloud.of(cloud, "source", seed % 7), Cloud.of(cloud[order], "source", seed % 7)
    assert (one.values == two.values).all()
    assert (order[two.rows] == one.rows).all()


def _file(kind):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(12, 3))
    buffer = io.BytesIO()
    if kind in (".npy", ".npz"):
        (np.save if kind == ".npy" else np.savez)(buffer, points)
        return buffer.getvalue()
    if kind in (".xyz", ".csv", ".txt", ".asc", ".pts"):
        return "\n".join(" ".join(map(str, row)) for row in points).encode()
    if kind == ".pcd":
        head = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 12\nHEIGHT 1\n"
        head += "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 12\nDATA binary\n"
        return head.encode() + points.astype("<f4").tobytes()
    if kind == ".ply":
        return trimesh.PointCloud(points).export(file_type="ply")
    content = trimesh.creation.box().export(file_type=kind[1:])
    if isinstance(content, dict):  # without the files that a .gltf names
        content = content["model.gltf"]
    return content.encode() if isinstance(content, str) else content


KINDS = (
    ".ply", ".stl", ".off", ".obj", ".glb", ".gltf",
    ".pcd", ".xyz", ".txt", ".csv", ".asc", ".pts", ".npy", ".npz",
)  # fmt: skip
WHOLE = {kind: _file(kind) for kind in KINDS}


@given(
    st.sampled_from(KINDS),
    st.lists(st.tuples(st.floats(0, 1), st.binary(min_size=0, max_size=4)), max_size=4),
    st.floats(0, 1.2),
)
@settings(max_examples=400)
@pytest.mark.filterwarnings("ignore")
def test_a_mutated_file_gives_points_or_the_projects_own_error(kind, changes, share):
    content = bytearray(WHOLE[kind])
    for place, bytes_ in changes:
        at = int(place * len(content))
        content[at : at + len(bytes_)] = bytes_
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"mutated{kind}"
        path.write_bytes(content[: int(share * len(content))] if share < 1 else content)
        try:
            points = read_scan(path)
        except CorrmatError:
            return
    assert points.ndim == 2
    assert points.shape[1] == 3
    assert points.dtype == np.float64
    with contextlib.suppress(CorrmatError):
        Cloud.of(points, "source", 0)
