"""Training of the verification network, on the candidates of the shipped weights.

Every training pair has a new shape and is registered up to its candidates. The network learns which
of the candidates that it would see are right, by the cross-entropy over them; the true transform,
refined like a candidate, and half turns of it are among them.
"""

import functools
import hashlib
import io
import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import lightning as L
import numpy as np
import torch
from lightning.pytorch.callbacks import ModelCheckpoint, RichProgressBar
from torch import Tensor
from torch.utils.data import DataLoader

from corrmat import weights
from corrmat.data.datamodule import PairDataset, RegistrationDataModule
from corrmat.files import replace_bytes
from corrmat.networks.verification import EVIDENCE, VerificationNetwork
from corrmat.ops import rigid
from corrmat.progress import track
from corrmat.registration import benchmark
from corrmat.registration.choice import (
    CHOICE_WEIGHTS,
    VERIFIED,
    CandidateSearch,
    best_by_measures,
    half_turned,
)
from corrmat.registration.hypotheses import NetworkHypotheses
from corrmat.registration.shipping import recalibrate
from corrmat.registration.verification import evidence
from corrmat.revision import commit
from corrmat.types import PairBatch

SIZES = 512, 560, 640, 768, 1024  # points of a cloud before it is cropped
PROTOCOLS: tuple[benchmark.Protocol, ...] = ("real", "views", "real", "views", "real", "clean")
STRETCH = 1.4
DATA = "shapes+assemblies+rooms"
PAIRS, STEPS = 30_000, 10_000
SHARD_PAIRS = 100
RIGHT = 0.15  # mean distance that a right transform's points have from their true place
BATCH_PAIRS = 8
RATE = 2e-3


class CandidateSet(NamedTuple):
    """The candidates of one pair."""

    features: Tensor  # (P, d) float16
    evidence: Tensor  # (T, P, EVIDENCE) float16
    nearest: Tensor  # (T, P) int16
    right: Tensor  # (T,) bool


def train_verification(
    runs: Path = Path("runs"),
    data: str = DATA,
    pairs: int = PAIRS,
    steps: int = STEPS,
    seed: int = 1,
    workers: int = 2,
) -> None:
    """Train the network that verifies the candidates of `corrmat register`, and ship it.

    The same command again goes on where it stopped. Only the whole training, of the default data,
    pairs and steps, ships; the confidence is fitted anew then.

    Args:
        runs: folder of candidates and checkpoints.
        data: generated shapes, a new one for every pair.
        pairs: to register, up to their candidates.
        steps: of training, eight pairs each.
        seed: of the pairs and of the network.
        workers: processes that make candidates; 0 makes them in this one.
    """
    today, verified = commit(), weights.checksum(weights.load_model())
    made_by = repr((SIZES, PROTOCOLS, STRETCH, RIGHT, CHOICE_WEIGHTS, VERIFIED, EVIDENCE))
    made_by = hashlib.sha256(made_by.encode()).hexdigest()[:8]  # others would be other candidates
    folder = runs / f"verification-{verified}-{made_by}" / data
    count = min(pairs, SHARD_PAIRS)
    shards = {n: folder / f"{seed}-{n}-{count}.pt" for n in range(-(-pairs // SHARD_PAIRS))}
    missing = {number: path for number, path in shards.items() if not path.is_file()}
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers or 1, spawn, torch.set_num_threads, (1,)) as pool:
        write = functools.partial(write_shard, data=data, seed=seed, count=count)
        written = (pool.map if workers else map)(write, missing.values(), missing)
        for _ in track(written, "candidates", len(missing)):
            pass
    sets = [
        CandidateSet(*content)
        for path in shards.values()
        for content in torch.load(path, mmap=True)
    ]
    useful = [each for each in sets if 0 < each.right.sum() < len(each.right)]
    print(f"{len(useful):,} of {len(sets):,} pairs have right and wrong candidates")
    L.seed_everything(seed, verbose=False)
    module = VerificationTraining(steps)
    loader = DataLoader(
        useful,  # pyright: ignore[reportArgumentType] (a list is a data set)
        BATCH_PAIRS,
        shuffle=True,
        drop_last=True,
        collate_fn=list,
    )
    checkpoints = folder / f"{seed}-{pairs}-{steps}"
    trainer = L.Trainer(
        max_steps=steps, max_epochs=-1, accelerator="cpu", logger=False,
        enable_model_summary=False, gradient_clip_val=1.0,
        callbacks=[
            ModelCheckpoint(checkpoints, every_n_train_steps=200, save_last=True),
            RichProgressBar(refresh_rate=10),
        ],
    )  # fmt: skip
    last = checkpoints / "last.ckpt"
    trainer.fit(module, loader, ckpt_path=last if last.is_file() else None)
    if (data, pairs, steps) != (DATA, PAIRS, STEPS):
        print(f"{last}: a trial; only the default data, pairs and steps ship")
        return
    path = weights.ship_network(
        "verification", "verification", {}, module.network,
        verifies=verified, pairs=str(len(useful)), seed=str(seed), commit=str(today),
    )  # fmt: skip
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")
    recalibrate()


def write_shard(path: Path, number: int, *, data: str, seed: int, count: int) -> None:
    """Make the candidates of `count` pairs of one size and write them to a file."""
    size = SIZES[number % len(SIZES)]
    clouds = RegistrationDataModule(data, new_shapes=True, seed=seed).clouds("train")
    rng = np.random.default_rng((seed, number))
    generate = NetworkHypotheses(weights.load_model())
    sets = []
    for index in range(count):
        protocol = PROTOCOLS[index % len(PROTOCOLS)]
        settings = replace(benchmark.PROTOCOLS[protocol], num_points=size, stretch=STRETCH)
        dataset = PairDataset(clouds, settings, seed, "train", new_shapes=True)
        pair = dataset[number * SHARD_PAIRS + index, int(rng.integers(len(clouds)))]
        sets.append(tuple(candidate_set(pair, generate)))
    path.parent.mkdir(parents=True, exist_ok=True)
    content = io.BytesIO()
    torch.save(sets, content)
    replace_bytes(path, content.getbuffer())


def candidate_set(pairs: PairBatch, generate: NetworkHypotheses) -> CandidateSet:
    """Register a pair, a batch of one, up to its candidates, and label them."""
    source, target = (c[0].double().numpy() for c in (pairs.source, pairs.target))
    search = CandidateSearch.start(generate, source, target, 0)
    clouds = search.clouds
    truth = rigid.to_homogeneous(pairs.rotation[0], pairs.translation[0])
    truth = clouds.from_original_units(truth)
    candidates, measures = search.find(half_turns=True)
    best = candidates[best_by_measures(measures, CHOICE_WEIGHTS, VERIFIED)]
    refined = search.refine_a_little(truth[None])
    half_turns = search.refine_a_little(half_turned(refined[0], clouds.subsamples))
    transforms = np.concatenate([best, half_turns, refined])
    offsets = clouds.subsamples[0][:, :3] @ (transforms - truth)[:, :3, :3].transpose(0, 2, 1)
    offsets += (transforms - truth)[:, None, :3, 3]
    right = np.linalg.norm(offsets, axis=2).mean(1) < RIGHT
    features, points, nearest = evidence(transforms, search.hypotheses, clouds.subsamples)
    return CandidateSet(features.half(), points.half(), nearest.short(), torch.from_numpy(right))


class VerificationTraining(L.LightningModule):
    """Cross-entropy of the right candidates among those of a pair.

    Args:
        steps: of the training, for the rate's one cycle.
    """

    def __init__(self, steps: int) -> None:
        super().__init__()
        self.steps = steps
        self.network = VerificationNetwork()

    def training_step(self, batch: Sequence[CandidateSet], index: int) -> Tensor:
        """Compute the loss of some pairs, each rotated at random."""
        points = torch.cat([_rotated(each.evidence.float()) for each in batch])
        nearest = torch.cat([each.nearest.long() for each in batch])
        features = torch.cat(
            [each.features.float().expand(len(each.right), -1, -1) for each in batch]
        )
        with torch.autocast(points.device.type, torch.bfloat16):
            score = self.network(features, points, nearest)
        scores = score.float().split([len(each.right) for each in batch])
        losses = [
            torch.logsumexp(logits, 0) - torch.logsumexp(logits[each.right], 0)
            for logits, each in zip(scores, batch, strict=True)
        ]
        loss = torch.stack(losses).mean()
        self.log("loss", loss, prog_bar=True, batch_size=len(batch))
        return loss

    def configure_optimizers(self) -> dict[str, object]:
        """AdamW, one cycle of the rate."""
        optimizer = torch.optim.AdamW(self.network.parameters(), RATE, weight_decay=1e-2)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, self.steps, pct_start=0.05)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def _rotated(points: Tensor) -> Tensor:
    """Rotate or mirror the positions of all points (T, P, EVIDENCE) alike, at random."""
    rotation = torch.linalg.qr(torch.randn(3, 3))[0]
    return torch.cat([points[..., :-3], points[..., -3:] @ rotation], -1)
