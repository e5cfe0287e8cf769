"""Pairs for training, validation and test, made on the fly from either source of shapes."""

import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import lightning as L
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from corrmat.data import modelnet40, shapes
from corrmat.data.clouds import CloudSet
from corrmat.data.pairs import STREAM, Key, PairSettings, Sampling, Split, generator, make_pairs
from corrmat.errors import CorrmatError
from corrmat.types import PairBatch

VALIDATION_SHARE = 0.1
HELD_OUT = 3  # the stream that says which training shapes are held out


class PairDataset(Dataset[PairBatch]):
    """Pairs of a set of clouds. An item is named by (epoch, shape) and never changes."""

    def __init__(self, clouds: CloudSet, how: PairSettings, seed: int, split: Split) -> None:
        self.clouds, self.how, self.seed, self.stream = clouds, how, seed, STREAM[split]

    def __len__(self) -> int:
        return len(self.clouds)

    def __getitem__(self, item: tuple[int, int]) -> PairBatch:
        """The pair of one (epoch, shape), as a batch of one."""
        return self.__getitems__([item])

    def __getitems__(self, items: Sequence[tuple[int, int]]) -> PairBatch:
        """The DataLoader's way to ask for a whole batch."""
        chosen = [shape for _, shape in items]
        keys = [Key(self.seed, self.stream, epoch, shape) for epoch, shape in items]
        return make_pairs(self.clouds, chosen, keys, self.how)


class EpochSampler(Sampler[tuple[int, int]]):
    """Names the items of one epoch: every shape once, in a random order if `shuffle`.

    Of W processes the r-th gets every W-th item from r on, so that their batches together are
    those of one process with W times the batch. In training all get equally many, in validation
    every item comes once.

    A run that goes on in the middle of an epoch leaves out the first `done` items, once.
    """

    def __init__(
        self, size: int, seed: int, shuffle: bool, epoch: int = 0, done: int = 0,
        share: tuple[int, int] = (0, 1),
    ) -> None:  # fmt: skip
        self.size, self.seed, self.shuffle, self.epoch, self.done = size, seed, shuffle, epoch, done
        self.rank, self.world = share

    def set_epoch(self, epoch: int) -> None:
        """Lightning calls this before every epoch; frozen pairs stay in epoch 0."""
        self.epoch = epoch if self.shuffle else 0

    def __iter__(self) -> Iterator[tuple[int, int]]:
        order = np.arange(self.size)
        if self.shuffle:
            # The stream of an index no shape has.
            order = generator(Key(self.seed, STREAM["train"], self.epoch, 2**40)).permutation(order)
        own = order[self.rank :: self.world][: len(self)]
        left, self.done = own[self.done :], 0
        return ((self.epoch, int(shape)) for shape in left)

    def __len__(self) -> int:
        left_over = self.size % self.world if not self.shuffle else 0
        return self.size // self.world + (self.rank < left_over)


class RegistrationDataModule(L.LightningDataModule):
    """Pairs made on the fly: frozen for test and validation, new ones each epoch for training.

    Args:
        data: "shapes", the embedded data set, or "modelnet40", the official HDF5 files.
        root: folder of the HDF5 files; needed for modelnet40.
        num_points: see `PairSettings`, as for all up to outlier_distance.
        rotation_deg: largest angle.
        min_rotation_deg: smallest angle.
        translation: largest translation along an axis.
        keep: share of the source that stays after the crop.
        sampling: how the two clouds share points.
        jitter: noise on the coordinates.
        outliers: share of source points replaced.
        outlier_distance: from where on a source point counts as an outlier.
        spoilt: which clouds are cropped and get outliers.
        normals: where they come from.
        stretch: how far training shapes are drawn out along their axes; never test shapes.
        batch_size: pairs a batch.
        categories: only these; all by default.
        train_shapes: only the first so many training shapes (10 % of them held out).
        test_shapes: only the first so many test shapes.
        num_workers: processes that make pairs; 0 makes them in the training process, at a
            fraction of a millisecond each.
        seed: of the pairs and of the held-out shapes.
    """

    def __init__(
        self,
        data: Literal["shapes", "modelnet40"] = "shapes",
        root: str | None = None,
        num_points: int = 512,
        rotation_deg: float = 180.0,
        min_rotation_deg: float = 0.0,
        translation: float = 0.5,
        keep: float = 1.0,
        sampling: Sampling = "identical",
        jitter: float = 0.0,
        outliers: float = 0.0,
        outlier_distance: float = 0.05,
        spoilt: Literal["source", "both"] = "source",
        normals: Literal["given", "estimated"] = "given",
        stretch: float = 1.0,
        batch_size: int = 16,
        categories: list[str] | None = None,
        train_shapes: int | None = None,
        test_shapes: int | None = None,
        num_workers: int = 0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.how = PairSettings(
            num_points, rotation_deg, min_rotation_deg, translation, keep, sampling, jitter,
            outliers, outlier_distance, spoilt, normals, stretch,
        )  # fmt: skip
        self.data, self.root, self.categories = data, root, categories
        self.counts = {"train": train_shapes, "test": test_shapes}
        self.batch_size, self.num_workers, self.seed = batch_size, num_workers, seed
        self.goes_on = {"epoch": 0, "done": 0}  # where in training: for `EpochSampler`
        for name, value, least in (
            ("batch_size", batch_size, 1),
            ("num_workers", num_workers, 0),
            ("seed", seed, 0),
            ("train_shapes", train_shapes, 1),
            ("test_shapes", test_shapes, 1),
        ):
            if value is not None and value < least:
                raise CorrmatError(f"{name} = {value} is out of range")
        self._clouds: dict[str, CloudSet] = {}

    def setup(self, stage: str | None = None) -> None:
        """Read the clouds that a stage needs ("fit", "validate", "test"; None: all)."""
        if stage in ("fit", "validate", None):
            self.clouds("train")
        if stage in ("test", "predict", None):
            self.clouds("test")

    def clouds(self, split: Split) -> CloudSet:
        """The clean clouds of a split; read once.

        Raises:
            CorrmatError: they cannot be had, or have too few points for the pairs asked.
        """
        if split not in self._clouds:
            if split == "test":
                self._clouds["test"] = self._read("test")
            else:
                self._clouds |= self._split(self._read("train"))
        return self._clouds[split]

    def train_dataloader(self) -> DataLoader[PairBatch]:
        """Fresh pairs of every training shape in a new order each epoch."""
        return self._loader("train", self.how, self._share())

    def val_dataloader(self) -> DataLoader[PairBatch]:
        """One frozen pair of each held-out training shape."""
        return self._loader("val", replace(self.how, stretch=1.0), self._share())

    def test_dataloader(self, **changes: float) -> DataLoader[PairBatch]:
        """One frozen pair of each test shape; `changes` replace fields of PairSettings.

        All of them, however many processes train.
        """
        return self._loader("test", replace(self.how, stretch=1.0, **changes))

    def checksum(self, changes: Sequence[Mapping[str, float]] = ({},)) -> str:
        """What the frozen test pairs are, as text that is the same on every machine.

        A CRC of all matches, and the mean absolute coordinate of sources and of targets to five
        decimals: CPUs differ in the last bits of a coordinate.

        Args:
            changes: as for `test_dataloader`, one set of pairs each.
        """
        matches, total, count = 0, torch.zeros(2, dtype=torch.float64), torch.zeros(2)
        for how in changes:
            for batch in self.test_dataloader(**how):
                matches = zlib.crc32(batch.match.numpy().astype("<i8").tobytes(), matches)
                clouds = [cloud[..., :3].double() for cloud in (batch.source, batch.target)]
                total += torch.stack([cloud.abs().sum() for cloud in clouds])
                count += torch.tensor([cloud.numel() for cloud in clouds])
        source, target = (total / count).tolist()
        return f"{matches:08x} {source:.5f} {target:.5f}"

    def _share(self) -> tuple[int, int]:
        """Which of how many processes this is."""
        return (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)

    def _loader(
        self, split: Split, how: PairSettings, share: tuple[int, int] = (0, 1)
    ) -> DataLoader[PairBatch]:
        dataset = PairDataset(self.clouds(split), how, self.seed, split)
        training = split == "train"
        goes_on = self.goes_on if training else {}
        sampler = EpochSampler(len(dataset), self.seed, training, **goes_on, share=share)
        return DataLoader(
            dataset,
            batch_size=self.batch_size,
            sampler=sampler,
            num_workers=self.num_workers,
            collate_fn=_as_is,  # pyright: ignore[reportArgumentType] (__getitems__ makes the batch)
            drop_last=training and len(sampler) >= self.batch_size,
            persistent_workers=self.num_workers > 0,
            pin_memory=torch.cuda.is_available(),
        )

    def _read(self, split: Literal["train", "test"]) -> CloudSet:
        count = self.counts[split]
        if self.data == "shapes":
            clouds = shapes.load(split, count if self.categories is None else None)
        elif self.root is None:
            raise CorrmatError("data modelnet40 needs its folder: ROOT=... or --data.root ...")
        else:
            clouds = modelnet40.load(Path(self.root), split)
        if self.categories is not None:
            clouds = clouds.only(self.categories)
        clouds = clouds.take(slice(count))
        size, n = clouds.points.shape[1], self.how.num_points
        needed = 2 * n if self.how.sampling == "disjoint" else n
        if needed > size:
            raise CorrmatError(
                f"the clouds of {self.data} have {size} points, but {self.how.sampling} pairs of "
                f"num_points = {n} need {needed}; lower --data.num_points"
            )
        return clouds

    def _split(self, clouds: CloudSet) -> dict[str, CloudSet]:
        """Hold out 10 % of the training shapes (at least one), chosen by the seed."""
        if len(clouds) < 2:
            raise CorrmatError("training needs at least 2 shapes, one of them held out")
        order = generator(Key(self.seed, HELD_OUT, 0, 0)).permutation(len(clouds))
        held = max(1, round(VALIDATION_SHARE * len(clouds)))
        val, train = np.sort(order[:held]), np.sort(order[held:])
        return {"train": clouds.take(train), "val": clouds.take(val)}


def _as_is(batch: PairBatch) -> PairBatch:
    return batch
