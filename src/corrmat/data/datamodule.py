"""Pairs for training, validation and test, made on the fly from any data set of the registry."""

import hashlib
import signal
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import lightning as L
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from corrmat.data.clouds import CloudSet
from corrmat.data.pairs import (
    STREAM,
    Key,
    PairSettings,
    Purpose,
    Split,
    generator,
    make_pairs,
)
from corrmat.data.registry import DATASETS, is_generated, load_clouds
from corrmat.data.shapes.dataset import sample_shape
from corrmat.errors import CorrmatError
from corrmat.types import PairBatch

VALIDATION_SHARE = 0.1
_START = {"epoch": 0, "batches": 0}  # position in the training data
_HELD_OUT_STREAM = 3  # random stream that selects the held-out training shapes


class PairDataset(Dataset[PairBatch]):
    """Pairs of a set of clouds. An item is keyed by (epoch, shape) and never changes.

    Args:
        clouds: the clean clouds.
        settings: how pairs are drawn.
        seed: of the pairs.
        split: which pairs these are.
        new_shapes: make a new shape of the cloud's category for every item.
    """

    def __init__(
        self, clouds: CloudSet, settings: PairSettings, seed: int, split: Split,
        new_shapes: bool = False,
    ) -> None:  # fmt: skip
        self.clouds, self.settings, self.new_shapes = clouds, settings, new_shapes
        self.seed, self.stream = seed, STREAM[split]

    def __len__(self) -> int:
        return len(self.clouds)

    def __getitem__(self, item: tuple[int, int]) -> PairBatch:
        """Make the pair of one (epoch, shape), as a batch of one."""
        return self.__getitems__([item])

    def __getitems__(self, items: Sequence[tuple[int, int]]) -> PairBatch:
        """Make a batch of pairs (the DataLoader's protocol)."""
        shapes = [shape for _, shape in items]
        keys = [Key(self.seed, self.stream, epoch, shape) for epoch, shape in items]
        if not self.new_shapes:
            return make_pairs(self.clouds, shapes, keys, self.settings)
        labels = self.clouds.labels[shapes]
        rows = [
            sample_shape(self.clouds.names[label], generator(key, Purpose.SHAPE))
            for label, key in zip(labels, keys, strict=True)
        ]
        clouds = CloudSet(np.stack(rows), labels, self.clouds.names)
        pairs = make_pairs(clouds, range(len(rows)), keys, self.settings)
        return replace(pairs, shape=torch.as_tensor(shapes))


class EpochSampler(Sampler[tuple[int, int]]):
    """Yield (epoch, shape) indices for one epoch, shuffled in training, split over processes.

    Process r of W gets every W-th item from r on, so that their batches together are those of one
    process with W times the batch. In training all processes get equally many items; in
    validation every item comes once.

    Args:
        size: number of shapes.
        seed: of the shuffling.
        shuffle: whether this is training.
        epoch: the first epoch.
        skip: items of the first epoch to leave out, for a run that resumes in the middle of it.
        share: rank and number of processes.
    """

    def __init__(
        self, size: int, seed: int, shuffle: bool, epoch: int = 0, skip: int = 0,
        share: tuple[int, int] = (0, 1),
    ) -> None:  # fmt: skip
        self.size, self.seed, self.shuffle, self.epoch, self.skip = size, seed, shuffle, epoch, skip
        self.rank, self.world_size = share

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch (Lightning calls this); frozen pairs stay in epoch 0."""
        self.epoch = epoch if self.shuffle else 0

    def __iter__(self) -> Iterator[tuple[int, int]]:
        order = np.arange(self.size)
        if self.shuffle:
            # The stream of an index that no shape has.
            order = generator(Key(self.seed, STREAM["train"], self.epoch, 2**40)).permutation(order)
        mine = order[self.rank :: self.world_size][: len(self)]
        rest, self.skip = mine[self.skip :], 0
        return ((self.epoch, int(shape)) for shape in rest)

    def __len__(self) -> int:
        remainder = self.size % self.world_size if not self.shuffle else 0
        return self.size // self.world_size + (self.rank < remainder)


class RegistrationDataModule(L.LightningDataModule):
    """Pairs made on the fly: frozen for validation and test, new ones each epoch for training.

    Args:
        data: a data set of `corrmat.data.registry`: "shapes", "assemblies" or "rooms" (embedded),
            "modelnet40" (official HDF5 files) or "folder" (meshes or clouds of your own); or
            several, e.g. "shapes+assemblies".
        root: folder of "modelnet40" or "folder".
        name: what the data set is called in results/; by default `data`, or the folder's name.
        batch_size: pairs a batch.
        categories: only these; all by default.
        train_shapes: only the first so many training shapes (a tenth of them held out).
        test_shapes: only the first so many test shapes.
        num_workers: processes that make pairs; 0 makes them in the training process. A pair
            takes a fraction of a millisecond; with new shapes or views, tens.
        seed: of the pairs and of the held-out shapes.
        new_shapes: train on new shapes in every epoch, of the categories of the training shapes:
            only for data sets that `is_generated`. No training shape of the data set is then
            trained on, whatever the seed; those held out are the ones of seed 0.
        pair_settings: fields of `PairSettings`, e.g. num_points=512, keep=0.7.

    Raises:
        CorrmatError: a setting is out of range.
    """

    def __init__(
        self,
        data: str = "shapes",
        root: str | None = None,
        name: str | None = None,
        batch_size: int = 16,
        categories: list[str] | None = None,
        train_shapes: int | None = None,
        test_shapes: int | None = None,
        num_workers: int = 0,
        seed: int = 0,
        new_shapes: bool = False,
        **pair_settings: Any,  # noqa: ANN401 (typed by PairSettings, which checks them)
    ) -> None:
        super().__init__()
        self.pairs = PairSettings(**pair_settings)
        self.data, self.root, self.name = data, root, name
        self.categories = categories
        self.counts = {"train": train_shapes, "test": test_shapes}
        self.batch_size, self.num_workers, self.seed = batch_size, num_workers, seed
        self.new_shapes = new_shapes
        self._resume_state = _START.copy()
        for key, value, least in (
            ("batch_size", batch_size, 1),
            ("num_workers", num_workers, 0),
            ("seed", seed, 0),
            ("train_shapes", train_shapes, 1),
            ("test_shapes", test_shapes, 1),
        ):
            if value is not None and value < least:
                raise CorrmatError(f"{key} = {value} is out of range")
        if new_shapes and not is_generated(data):
            raise CorrmatError(f"new_shapes: shapes of {data} cannot be made")
        self._clouds: dict[str, CloudSet] = {}

    def setup(self, stage: str | None = None) -> None:
        """Open the clouds that a stage needs ("fit", "validate", "test"; None: all)."""
        if stage == "fit":  # if a training is resumed, `load_state_dict` follows
            self._resume_state = _START.copy()
        if stage in ("fit", "validate", None):
            self.clouds("train")
        if stage in ("test", "predict", None):
            self.clouds("test")

    def clouds(self, split: Split) -> CloudSet:
        """Return the clean clouds of a split; opened once.

        Raises:
            CorrmatError: they cannot be read, or have too few points for the pairs.
        """
        if split not in self._clouds:
            if split == "test":
                self._clouds["test"] = self._load("test")
            else:
                self._clouds |= self._hold_out(self._load("train"))
        return self._clouds[split]

    def train_dataloader(self) -> DataLoader[PairBatch]:
        """Return fresh pairs of every training shape in a new order each epoch."""
        return self._loader("train", self.pairs, self._share())

    def count_train_batches(self, processes: int = 1) -> int:
        """Count the batches of an epoch that each of several processes has."""
        return len(self._loader("train", self.pairs, (0, processes)))

    def val_dataloader(self) -> DataLoader[PairBatch]:
        """Return one frozen pair of each held-out training shape."""
        return self._loader("val", replace(self.pairs, stretch=1.0), self._share())

    def test_dataloader(self, **changes: Any) -> DataLoader[PairBatch]:  # noqa: ANN401
        """Return one frozen pair of each test shape, in every process.

        Args:
            changes: fields of `PairSettings` to replace.
        """
        return self._loader("test", replace(self.pairs, stretch=1.0, **changes))

    @property
    def test_settings(self) -> tuple[object, ...]:
        """Whatever the test pairs depend on."""
        shapes = self.data, self.root, self.categories, self.counts["test"], self.seed
        return *shapes, replace(self.pairs, stretch=1.0)

    def state_dict(self) -> dict[str, int]:
        """Return the position in the training data: Lightning saves it in every checkpoint."""
        if self.trainer is None:
            return self._resume_state
        batches = self.trainer.fit_loop.batch_idx + 1
        # After a whole epoch the next one starts at its beginning.
        return {
            "epoch": self.trainer.current_epoch,
            "batches": batches % max(1, int(self.trainer.num_training_batches)),
        }

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        """Continue training at a position: Lightning calls this before it asks for loaders."""
        self._resume_state = dict(state_dict)

    def test_pairs_digest(self, changes: Sequence[Mapping[str, float]] = ({},)) -> str:
        """Compute a digest of the frozen test pairs that is the same on every machine.

        It covers shapes, matches, the true transforms to four decimals and the centroid of each
        source to three: coarse enough for CPUs that differ in the last bits of a coordinate.

        Args:
            changes: as for `test_dataloader`, one set of pairs each.

        Returns:
            16 hexadecimal digits.
        """
        digest = hashlib.sha256()
        for fields in changes:
            for batch in self.test_dataloader(**fields):
                centroid = batch.source[..., :3].double().mean(1)
                transform = torch.cat([batch.rotation.flatten(1), batch.translation], 1).double()
                rounded = torch.cat([transform * 1e4, centroid * 1e3], 1).round().long()
                pairs = torch.cat([rounded, batch.match, batch.shape.unsqueeze(1)], 1)
                digest.update(pairs.numpy().astype("<i4").tobytes())
        return digest.hexdigest()[:16]

    def _share(self) -> tuple[int, int]:
        """Return the rank of this process and the number of processes."""
        return (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)

    def _loader(
        self, split: Split, settings: PairSettings, share: tuple[int, int] = (0, 1)
    ) -> DataLoader[PairBatch]:
        """Build the DataLoader of a split; a resumed training continues at its position."""
        training = split == "train"
        new_shapes = self.new_shapes and training
        dataset = PairDataset(self.clouds(split), settings, self.seed, split, new_shapes)
        start = self._resume_state if training else _START
        epoch, batches = start["epoch"], start["batches"]
        skip = batches * self.batch_size
        sampler = EpochSampler(len(dataset), self.seed, training, epoch, skip, share)
        return DataLoader(
            dataset,
            batch_size=self.batch_size,
            sampler=sampler,
            num_workers=self.num_workers,
            worker_init_fn=_ignore_ctrl_c,
            collate_fn=_already_a_batch,  # pyright: ignore[reportArgumentType] (see __getitems__)
            drop_last=training and len(sampler) >= self.batch_size,
            persistent_workers=self.num_workers > 0,
            pin_memory=torch.cuda.is_available(),
        )

    def _load(self, split: Literal["train", "test"]) -> CloudSet:
        """Load a split and check that its clouds have enough points."""
        count = self.counts[split]
        root = None if self.root is None else Path(self.root)
        clouds = load_clouds(self.data, split, count if self.categories is None else None, root)
        if self.categories is not None:
            clouds = clouds.only(self.categories).select(slice(count))
        if self.pairs.min_cloud_points > clouds.num_points:
            raise CorrmatError(
                f"the clouds of {self.data} have {clouds.num_points} points, but "
                f"{self.pairs.sampling} pairs of num_points = {self.pairs.num_points} need "
                f"{self.pairs.min_cloud_points}; lower --data.num_points"
            )
        return clouds

    def _hold_out(self, clouds: CloudSet) -> dict[str, CloudSet]:
        """Hold out 10 % of the training shapes (at least one), chosen by the seed."""
        if len(clouds) < 2:
            raise CorrmatError("training needs at least 2 shapes, one of them held out")
        seed = 0 if self.new_shapes else self.seed
        order = generator(Key(seed, _HELD_OUT_STREAM, 0, 0)).permutation(len(clouds))
        held_out = max(1, round(VALIDATION_SHARE * len(clouds)))
        val, train = np.sort(order[:held_out]), np.sort(order[held_out:])
        return {"train": clouds.select(train), "val": clouds.select(val)}


def data_name(data: str, root: str | None, name: str | None) -> str:
    """Return the folder name of a data set in results/: `name`, or the folder's, or `data`.

    Raises:
        CorrmatError: `name` is no plain name, or that of another data set.
    """
    if name is not None and (name != Path(name).name or name in ("", "..")):
        raise CorrmatError(f"--data.name {name!r} is not the name of one folder")
    called = name or (Path(root).resolve().name if data == "folder" and root else data)
    if called != data and called in DATASETS:
        raise CorrmatError(
            f"{called} is another data set: its records would be overwritten; choose a --data.name"
        )
    return called


def _ignore_ctrl_c(_worker: int) -> None:
    """Leave Ctrl-C, which a terminal sends to every process, to the one that trains."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _already_a_batch(batch: PairBatch) -> PairBatch:
    return batch
