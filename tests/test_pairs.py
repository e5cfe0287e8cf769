import dataclasses

import numpy as np
import pytest
import torch

from corrmat.data import datamodule as datamodules
from corrmat.data.clouds import CloudSet
from corrmat.data.datamodule import RegistrationDataModule
from corrmat.data.pairs import Key, PairSettings, Purpose, generator, make_pairs
from corrmat.data.visibility import depth_noise
from corrmat.errors import CorrmatError
from corrmat.ops import rigid


@pytest.fixture(scope="module")
def clouds():
    rng = np.random.default_rng(0)
    normals = rng.standard_normal((5, 128, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    points = rng.uniform(-0.6, 0.6, (5, 128, 3)).astype(np.float32)
    return CloudSet(np.concatenate([points, normals], -1), np.zeros(5, np.int64), ("thing",))


def pairs_of(clouds, epoch=0, **options):
    keys = [Key(0, 0, epoch, i) for i in range(len(clouds))]
    return make_pairs(
        clouds, range(len(clouds)), keys, PairSettings(**{"num_points": 40} | options)
    )


def aligned(pairs):
    return rigid.apply(pairs.rotation, pairs.translation, pairs.source[..., :3])


def matched(pairs):
    index = pairs.match.clamp_max(pairs.target.shape[1] - 1).unsqueeze(-1).expand(-1, -1, 6)
    return torch.gather(pairs.target, 1, index)


@pytest.mark.parametrize("keep", [1.0, 0.7])
def test_the_true_motion_takes_each_point_and_normal_onto_its_match(clouds, keep):
    pairs = pairs_of(clouds, keep=keep)
    assert pairs.source.shape == (5, round(keep * 40), 6)
    assert pairs.target.shape == (5, 40, 6)
    torch.testing.assert_close(aligned(pairs), matched(pairs)[..., :3], atol=1e-6, rtol=0)
    normals = pairs.source[..., 3:] @ pairs.rotation.mT
    torch.testing.assert_close(normals, matched(pairs)[..., 3:], atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    "options", [{}, {"keep": 0.7}, {"sampling": "independent"}, {"sampling": "disjoint"}]
)
def test_the_match_is_the_nearest_target_point(clouds, options):
    pairs = pairs_of(clouds, **options)
    nearest = torch.cdist(aligned(pairs), pairs.target[..., :3]).argmin(-1)
    assert torch.equal(pairs.match, nearest)


def test_sampling_shares_all_some_or_no_points(clouds):
    def shared(sampling):
        pairs = pairs_of(clouds, num_points=60, sampling=sampling)
        distance = torch.cdist(aligned(pairs).double(), pairs.target[..., :3].double()).amin(-1)
        return (distance < 1e-5).float().mean()

    assert shared("identical") == 1
    assert 0.3 < shared("independent") < 0.7
    assert shared("disjoint") == 0


def test_target_order_is_shuffled(clouds):
    pairs = pairs_of(clouds)
    assert not (pairs.match == torch.arange(40)).all(1).any()


def test_a_crop_leaves_one_side_of_a_plane_through_the_centroid(clouds):
    """What is left and what is gone are separated by a plane; counts are exact."""
    from scipy.optimize import linprog

    pairs = pairs_of(clouds, keep=0.7)
    assert pairs.source.shape[1] == 28
    full = torch.gather(
        pairs.target[..., :3], 1, torch.arange(40).expand(5, -1).unsqueeze(-1).expand(-1, -1, 3)
    )
    for b in range(5):
        kept = torch.zeros(40, dtype=torch.bool)
        kept[pairs.match[b]] = True
        sign = torch.where(kept, 1.0, -1.0)[:, None]
        rows = -sign * torch.cat([full[b], torch.ones(40, 1)], 1)
        assert linprog(np.zeros(4), rows.numpy(), -np.ones(40), bounds=(None, None)).success


def test_angles_and_translations_stay_in_their_range_and_fill_it(clouds):
    def angles(**options):
        drawn = torch.cat([pairs_of(clouds, epoch, **options).rotation for epoch in range(60)])
        cosine = (drawn.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2
        return torch.rad2deg(torch.acos(cosine.clamp(-1, 1)))

    assert 40 < angles(rotation_deg=45.0).max() <= 45.1
    band = angles(min_rotation_deg=120.0, rotation_deg=150.0)
    assert 119.9 < band.min() < 123
    assert 147 < band.max() < 150.1
    assert angles(rotation_deg=180.0).mean() == pytest.approx(90, abs=8)
    shifts = torch.cat([pairs_of(clouds, epoch).translation for epoch in range(60)])
    assert 0.48 < shifts.abs().max() <= 0.5
    assert (pairs_of(clouds, translation=0.0).translation == 0).all()


def test_jitter_moves_both_clouds_and_not_the_truth(clouds):
    clean, noisy = pairs_of(clouds), pairs_of(clouds, jitter=0.01)
    assert torch.equal(clean.match, noisy.match)
    for name in ("source", "target"):
        spread = (getattr(noisy, name) - getattr(clean, name))[..., :3].std()
        assert spread == pytest.approx(0.01, rel=0.15)


def test_outliers_are_replaced_labelled_and_otherwise_nothing_changes(clouds):
    clean, dirty = pairs_of(clouds), pairs_of(clouds, outliers=0.2, outlier_distance=0.02)
    replaced = (clean.source != dirty.source).any(-1)
    assert (replaced.sum(1) == 8).all()
    assert dirty.source[replaced][:, :3].abs().max() <= 0.5
    distance = torch.cdist(aligned(dirty), dirty.target[..., :3]).amin(-1)
    assert torch.equal(dirty.match == 40, distance > 0.02)
    assert torch.equal(dirty.match[~replaced], clean.match[~replaced])


def jitter_of(clouds, **settings):
    """The noise alone: what jitter adds to the coordinates."""
    noisy, clean = (pairs_of(clouds, jitter=j, **settings) for j in (0.01, 0.0))
    return noisy.source[..., :3] - clean.source[..., :3]


def test_settings_that_are_off_do_not_shift_those_that_are_on(clouds):
    """Every purpose draws from its own stream: switching one on moves no other."""
    plain, cropped = pairs_of(clouds), pairs_of(clouds, keep=0.5, rotation_deg=90.0)
    assert torch.equal(plain.translation, cropped.translation)
    alone = jitter_of(clouds)
    assert alone.abs().max() > 0.01
    for settings in ({"outliers": 0.2}, {"corrupted": "both"}, {"keep": 1.0, "translation": 0.1}):
        torch.testing.assert_close(jitter_of(clouds, **settings), alone, atol=1e-6, rtol=0)
    one = pairs_of(clouds, outliers=0.2)
    both = pairs_of(clouds, outliers=0.2, jitter=0.001, normals="estimated", stretch=1.2)
    replaced = (one.source != plain.source).any(-1)
    points = one.source[replaced][:, :3], both.source[replaced][:, :3]
    torch.testing.assert_close(*points, atol=0.01, rtol=0)
    other = pairs_of(clouds, outliers=0.2, corrupted="both")
    assert torch.equal(one.source[replaced], other.source[replaced])


def test_purposes_have_streams_of_their_own():
    draws = {generator(Key(0, 0, 0, 0), purpose).random() for purpose in Purpose}
    assert len(draws) == len(Purpose)


def test_keys_that_differ_in_one_place_draw_differently():
    keys = [Key(0, 0, 0, 0), Key(1, 0, 0, 0), Key(0, 1, 0, 0), Key(0, 0, 1, 0), Key(0, 0, 0, 1)]
    assert len({generator(key).random() for key in keys}) == 5


@pytest.mark.parametrize(
    "change",
    [
        {"keep": 0.0}, {"keep": 1.2}, {"num_points": 2}, {"rotation_deg": 200.0}, {"jitter": -1.0},
        {"min_rotation_deg": 181.0}, {"translation": -0.1}, {"outliers": 1.0},
        {"outlier_distance": 0.0},
    ],
)  # fmt: skip
def test_settings_out_of_range_are_named(change):
    with pytest.raises(CorrmatError, match=next(iter(change))):
        PairSettings(**change)


def datamodule(**options):
    return RegistrationDataModule(
        num_points=32, batch_size=5, train_shapes=24, test_shapes=7, **options
    )


def all_items(loader):
    return [dataclasses.astuple(batch) for batch in loader]


@pytest.mark.parametrize("split", ["train", "val", "test"])
def test_batches_are_equal_for_any_number_of_workers(split):
    results = []
    for workers in (0, 1, 2):
        loader = getattr(datamodule(num_workers=workers), f"{split}_dataloader")()
        loader.sampler.set_epoch(3)
        results.append(all_items(loader))
    assert len(results[0]) > 0
    for batches in zip(*results, strict=True):
        for fields in zip(*batches, strict=True):
            assert all(torch.equal(fields[0], other) for other in fields[1:])


def test_test_pairs_are_frozen_and_training_pairs_are_not():
    data = datamodule()
    test, train = data.test_dataloader(), data.train_dataloader()
    first, again = all_items(test), all_items(test)
    test.sampler.set_epoch(5)
    later = all_items(test)
    assert all(
        torch.equal(a[0], b[0]) and torch.equal(a[0], c[0])
        for a, b, c in zip(first, again, later, strict=True)
    )
    zero = all_items(train)
    train.sampler.set_epoch(1)
    assert not any(torch.equal(a[0], b[0]) for a, b in zip(zero, all_items(train), strict=True))


def test_a_pair_does_not_depend_on_its_batch():
    one, many = datamodule(), datamodule()
    one.batch_size = 1
    single = [dataclasses.astuple(b) for b in one.test_dataloader()]
    for position, batch in enumerate(
        b for big in many.test_dataloader() for b in zip(*dataclasses.astuple(big), strict=True)
    ):
        for a, b in zip(single[position], batch, strict=True):
            torch.testing.assert_close(a[0], b, rtol=1e-6, atol=1e-6)


def test_the_digest_is_of_the_pairs_and_of_nothing_else():
    expected = datamodule().test_pairs_digest()
    assert datamodule(num_workers=2).test_pairs_digest() == expected
    one = datamodule()
    one.batch_size = 1
    assert one.test_pairs_digest() == expected
    others = [
        datamodule(seed=1).test_pairs_digest(),
        datamodule().test_pairs_digest([{"rotation_deg": 9.0}]),
        datamodule(categories=["airplane", "chair", "guitar"]).test_pairs_digest(),
    ]
    assert len({expected, *others}) == 4
    # The last bits of a coordinate are the machine's own.
    clouds = one.clouds("test")
    clouds.rows[:] = np.nextafter(clouds.rows, np.float32(1))
    assert one.test_pairs_digest() == expected


def test_the_digest_is_of_the_shapes_too():
    """Identical sampling: matches and transforms do not depend on the shapes at all."""
    one, other = datamodule(), datamodule()
    assert one.test_pairs_digest() == other.test_pairs_digest()
    other.clouds("test").rows[:] = other.clouds("test").rows[::-1].copy()
    assert one.test_pairs_digest() != other.test_pairs_digest()


def test_a_tenth_of_train_is_held_out_by_seed():
    splits = [datamodule(seed=seed) for seed in (0, 0, 1)]
    held = [{row.tobytes() for row in s.clouds("val").rows} for s in splits]
    kept = {row.tobytes() for row in splits[0].clouds("train").rows}
    assert len(held[0]) == 2
    assert len(kept) == 22
    assert not held[0] & kept
    assert held[0] == held[1] != held[2]


def test_every_epoch_has_new_shapes_of_the_same_categories(monkeypatch):
    data = {"data": "shapes+assemblies", "train_shapes": 90, "num_points": 64, "batch_size": 4}
    module = RegistrationDataModule(**data, new_shapes=True, normals="estimated")
    known, made, sample_shape = module.clouds("train"), [], datamodules.sample_shape

    def remember(name, rng):
        made.append(name)
        return sample_shape(name, rng)

    monkeypatch.setattr(datamodules, "sample_shape", remember)
    dataset = module.train_dataloader().dataset
    items = [(epoch, shape) for epoch in range(2) for shape in (0, 1, 80)]
    shapes = np.concatenate([dataset[item].clean.numpy() for item in items])
    assert made == [known.names[known.labels[shape]] for _, shape in items]
    assert [dataset[item].shape.item() for item in items] == [shape for _, shape in items]
    again = np.concatenate([dataset[item].clean.numpy() for item in items])
    np.testing.assert_array_equal(shapes, again)
    everything = np.concatenate([known.rows[:, :, :3], shapes]).reshape(len(known) + 6, -1)
    assert len(np.unique(everything, axis=0)) == len(everything)


def test_shapes_held_out_do_not_depend_on_the_seed_where_none_is_trained_on():
    one, other = (datamodule(seed=seed, new_shapes=True) for seed in (0, 1))
    np.testing.assert_array_equal(one.clouds("val").rows, other.clouds("val").rows)
    np.testing.assert_array_equal(one.clouds("val").rows, datamodule().clouds("val").rows)


def test_shapes_of_files_cannot_be_new():
    with pytest.raises(CorrmatError, match="shapes of modelnet40 cannot be made"):
        RegistrationDataModule(data="modelnet40", new_shapes=True)


def test_too_few_points_are_an_error_that_says_how_many():
    with pytest.raises(
        CorrmatError, match="have 2048 points, but disjoint pairs of num_points = 1500 need 3000"
    ):
        RegistrationDataModule(
            num_points=1500, sampling="disjoint", test_shapes=2
        ).test_dataloader()
    with pytest.raises(CorrmatError, match="at least 2 shapes"):
        RegistrationDataModule(train_shapes=1).train_dataloader()
    with pytest.raises(CorrmatError, match="test split has 800 shapes, 801 were asked for"):
        RegistrationDataModule(test_shapes=801).test_dataloader()


SCANS = {
    "keep": 0.7, "sampling": "disjoint", "jitter": 0.01, "outliers": 0.1, "outlier_distance": 0.1,
    "corrupted": "both", "normals": "estimated",
}  # fmt: skip


def test_both_clouds_can_be_cropped_noisy_and_hold_outliers(clouds):
    pairs = pairs_of(clouds, **SCANS)
    assert pairs.source.shape == pairs.target.shape == (5, 28, 6)
    distance = torch.cdist(aligned(pairs), pairs.target[..., :3])
    near, at = distance.min(2)
    # Labels are of the clouds before their noise, which moves points by some hundredths.
    assert ((pairs.match == 28) | (near < 0.2)).all()
    assert ((pairs.match == 28) | (pairs.match == at)).double().mean() > 0.8
    assert 0.1 < (pairs.match == 28).double().mean() < 0.95
    clean = torch.cdist(pairs.source[..., :3], pairs.clean).amin(2)
    assert ((clean > 0.1).sum(1) <= 3).all()  # 10 % of 28 are outliers, the rest lie on the shape


def test_estimated_normals_come_from_the_cloud_itself(clouds):
    from corrmat.data.normals import estimate_normals as estimate

    pairs = pairs_of(clouds, **SCANS)
    for cloud in pairs.source.numpy():
        assert (cloud[:, 3:] == estimate(cloud[:, :3])).all()
    length = pairs.target[..., 3:].norm(dim=-1)
    torch.testing.assert_close(length, torch.ones_like(length))


def test_spoiling_both_clouds_leaves_the_draws_of_the_source_alone(clouds):
    one = pairs_of(clouds, **SCANS | {"corrupted": "source"})
    both = pairs_of(clouds, **SCANS)
    assert torch.equal(one.source, both.source)
    assert torch.equal(one.rotation, both.rotation)


def test_stretched_shapes_are_others_of_the_same_size(clouds):
    plain = pairs_of(clouds, **SCANS)
    drawn = pairs_of(clouds, **SCANS, stretch=1.5)
    assert not torch.equal(drawn.clean, plain.clean)
    radius = drawn.clean.norm(dim=-1).amax(1)
    torch.testing.assert_close(radius, torch.ones_like(radius))
    for before, after in zip(plain.clean.double(), drawn.clean.double(), strict=True):
        factors = torch.linalg.lstsq(before, after).solution
        torch.testing.assert_close(factors, factors.diagonal().diag(), atol=1e-5, rtol=0)
        share = factors.diagonal().abs() / factors.diagonal().abs().max()
        assert share.min() > 1.5**-2 - 1e-6


@pytest.mark.parametrize("stretch", [0.5, 2.0])
def test_stretching_needs_estimated_normals(stretch):
    with pytest.raises(CorrmatError, match="stretch"):
        PairSettings(stretch=stretch)


@pytest.fixture(scope="module")
def ball():
    """Points and normals of a sphere: a camera sees the half that faces it."""
    normals = np.random.default_rng(0).standard_normal((1, 2048, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return CloudSet(np.concatenate([0.8 * normals, normals], -1), np.zeros(1, np.int64), ("ball",))


def view(ball, **options):
    fixed = {"sampling": "disjoint", "corrupted": "both", "keep": 0.5, "views": 1.0}
    return pairs_of(ball, **fixed | {"num_points": 80, "translation": 0.0} | options)


def test_a_view_is_what_faces_its_camera(ball):
    pairs = view(ball, view_deg=0.0)
    points = torch.cat([aligned(pairs)[0], pairs.target[0, :, :3]])
    assert pairs.source.shape == pairs.target.shape == (1, 40, 6)
    toward = points.mean(0) / points.mean(0).norm()
    # From a distance of at most four, the horizon of a ball of 0.8 lies at 0.16 or beyond. Points
    # are too sparse to hide all of what is just behind it.
    assert (points @ toward > 0.16).float().mean() > 0.85
    assert (points @ toward).min() > -0.3
    assert not (torch.cdist(aligned(pairs), pairs.target[..., :3]) < 1e-6).any()


def test_views_from_opposite_sides_share_nothing(ball):
    def shares(view_deg):
        pairs = (view(ball, epoch=epoch, view_deg=view_deg, num_points=800) for epoch in range(20))
        return [(each.match < 400).float().mean().item() for each in pairs]

    assert min(shares(0.0)) > 0.8
    assert min(shares(180.0)) < 0.1


def test_a_view_that_sees_few_points_repeats_them(ball):
    pairs = view(ball, num_points=900, keep=1.0)
    assert pairs.source.shape == (1, 900, 6)
    assert len(pairs.source[0].unique(dim=0)) < 500


def test_noise_of_a_view_lies_on_the_rays_and_grows_with_distance():
    camera, noise = np.array([0.0, 0, 3]), np.full((2, 3), 0.01)
    moved = depth_noise(np.array([[0.0, 0, 1], [0.0, 0, -1]]), camera, noise)
    np.testing.assert_allclose(moved, [[0, 0, -0.04 / 9], [0, 0, -0.16 / 9]])


def test_part_of_the_pairs_are_views(clouds):
    fixed = {"sampling": "disjoint", "corrupted": "both", "keep": 0.7}
    whole, none = pairs_of(clouds, **fixed, views=1.0), pairs_of(clouds, **fixed)
    some = [pairs_of(clouds, epoch=e, **fixed, views=0.5) for e in range(4)]
    same = [
        torch.equal(a, b)
        for e, pairs in enumerate(some)
        for a, b in zip(pairs.source, pairs_of(clouds, epoch=e, **fixed).source, strict=True)
    ]
    assert 3 < sum(same) < 17
    assert not torch.equal(whole.source, none.source)


@pytest.mark.parametrize("wrong", [{"views": 0.5}, {"views": -0.1}, {"view_deg": 200.0}])
def test_views_need_two_scans(wrong):
    with pytest.raises(CorrmatError, match="out of range"):
        PairSettings(**wrong)


def test_a_crop_that_leaves_two_points_is_refused():
    with pytest.raises(CorrmatError, match="num_points = 3, of which keep = 0.7 leaves 2"):
        PairSettings(num_points=3, keep=0.7)
