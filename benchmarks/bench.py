"""Speed and memory of what costs, beside naive twins, and how both grow with the clouds.

    make bench                  a table on the screen, results/bench/bench.json and growth.png
    make bench ARGS=register    the two rows of `corrmat register` alone, into the last bench.json

Times are medians after a warm-up (growth above 4096 points: the first step's); memory is the
peak of a process of its own above what it held before its first step. A ratio says how many times
longer a twin takes: an operation's in the same process, turn by turn. Ours tells glibc to keep
freed memory. A step of the released formulation is timed both ways, so and with glibc as it comes,
as its users run it, each in a process of its own: gigabytes of a twin's heap slow ours down.
The twins are in tests/twins.py: the same values in the released formulation (NCHW edges, whole
matrices, an SVD a pair, target features anew).
"""

import contextlib
import json
import logging
import multiprocessing
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import torch
from matplotlib import pyplot as plt
from torch.utils.flop_counter import FlopCounterMode

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import twins  # noqa: E402  # pyright: ignore[reportMissingImports]

from corrmat.data.clouds import finish_shards, open_shards, write_shard  # noqa: E402
from corrmat.data.datamodule import EpochSampler, PairDataset  # noqa: E402
from corrmat.data.pairs import Key, PairSettings, make_pairs  # noqa: E402
from corrmat.data.shapes import dataset  # noqa: E402
from corrmat.errors import CorrmatError  # noqa: E402
from corrmat.files import replace_json  # noqa: E402
from corrmat.losses import chamfer_loss, correspondence_loss  # noqa: E402
from corrmat.methods import METHODS  # noqa: E402
from corrmat.networks.dcp import DCPNetwork  # noqa: E402
from corrmat.networks.pcrnet import PCRNetCorrNetwork  # noqa: E402
from corrmat.networks.ppf import signless_pair_features  # noqa: E402
from corrmat.networks.rpmnet import RPMNetwork  # noqa: E402
from corrmat.ops import streaming  # noqa: E402
from corrmat.ops.correspondence import SinkhornCorrespondence, SoftCorrespondence  # noqa: E402
from corrmat.ops.neighbors import within_radius  # noqa: E402
from corrmat.ops.rigid import procrustes  # noqa: E402
from corrmat.registration.benchmark import frozen_pairs  # noqa: E402
from corrmat.registration.example import write_example  # noqa: E402
from corrmat.registration.hypotheses import CLASSICAL  # noqa: E402
from corrmat.registration.register import register  # noqa: E402
from corrmat.reporting.figures import BLUE, GREEN, RED  # noqa: E402
from corrmat.training.fit import fresh_method  # noqa: E402
from corrmat.training.hardware import keep_freed_memory  # noqa: E402
from corrmat.training.preflight import prepare  # noqa: E402
from corrmat.training.recipe import load as load_recipe  # noqa: E402
from corrmat.types import PairBatch  # noqa: E402
from corrmat.weights import shipped_metadata  # noqa: E402

Row = dict[str, Any]
DCP_LAPTOP = {"width": 96, "feedforward": 192, "edge_channels": (32, 32, 64, 128), "k": 6}
RPMNET_LAPTOP = {"width": 32, "k": 32, "annealing_width": 256}
SHIPPED = json.loads(shipped_metadata("corrmat")["network"])
# method, hyper-parameters, points, batch
STEPS: tuple[tuple[str, dict[str, Any], int, int], ...] = (
    ("DCP_corr", DCP_LAPTOP, 128, 4),
    ("DCP_corr", {}, 512, 16),
    ("DCP_corr", {}, 2048, 1),
    ("RPMNet_corr", RPMNET_LAPTOP, 256, 2),
    ("RPMNet_corr", {}, 1024, 4),
    ("PCRNet_corr", {}, 100, 32),
    ("PCRNet_corr", {}, 1024, 32),
    ("PCRNet", {}, 100, 8),
    ("Invariant_corr", SHIPPED, 358, 8),
)
COMPILED = (STEPS[0],)
POINTS = (256, 512, 1024, 2048, 4096, 8192)
RECORD = ROOT / "results" / "bench" / "bench.json"
GROWTH = {"DCP_corr, a step": POINTS, "RPMNet_corr, a step": POINTS, "loss and pose": POINTS}


def main() -> None:
    """Measure, print, write."""
    rows: list[Row] = []

    def add(what: str, row: Row) -> None:
        rows.append({"what": what, **row})
        figures = "  ".join(f"{name} {value}" for name, value in row.items())
        print(f"{what:58s} {figures}", flush=True)

    peak = in_a_process(matmul_peak)["gflops"]
    add("matrix product 2048^3, float32", {"gflops": peak})
    add("pairs, N=512, one core", in_a_process(pairs_a_second))
    add(
        "pairs, N=512, of 100,000 made-up shapes, the whole process",
        in_a_process(pairs_of_many_shapes),
    )
    for method, hparams, n, batch in STEPS:
        what = method, hparams, n, batch
        row = in_a_process(training_step, *what)
        row["peak_share"] = round(row.pop("gflop_a_pair") / row["ms_a_pair"] * 1e3 / peak, 2)
        row["peak_mb"] = in_a_process(peak_of_a_step, *what, loss_of)
        if METHODS[method].network_type in RELEASED:
            for name, keep in (("released_keeping_freed_memory", True), ("released", False)):
                alone = in_a_process(released_step, *what, keep)
                row[f"{name}_ratio"] = round(alone / row["ms_a_pair"], 2)
            row["released_peak_mb"] = in_a_process(peak_of_a_step, *what, released_loss)
        add(f"step of {step_name(*what)}", row)
    for method, hparams, n, batch in COMPILED:
        row = in_a_process(against_compiled, method, hparams, n, batch)
        first = row.pop("first_step_s")
        add(f"step of {method}, N={n}, batch {batch}, by torch.compile after {first} s", row)
    for method in ("DCP_corr", "RPMNet_corr", "PCRNet_corr"):
        add(f"one pair through {method}, N=1024", in_a_process(inference, method))
    add("one pair through FPFH + RANSAC, N=1024", in_a_process(classical, "ransac"))
    for what, measure in REGISTRATION.items():
        add(what, in_a_process(measure))
    for name in TWINS:
        add(name, in_a_process(against_twin, name))
    for n in (512, 2048, 8192):
        add(f"loss and pose, d=512, N={n}, streamed", in_a_process(against_dense, n))
    growth: dict[str, list[Row]] = {what: [] for what in GROWTH}
    for what, sizes in GROWTH.items():
        for n in sizes:
            row = in_a_process(grown, what, n)
            growth[what].append({"n": n, **row})
            add(f"{what}, one pair, N={n}", row)
    exponents = {what: fitted(measured) for what, measured in growth.items()}
    for what, exponent in exponents.items():
        print(f"{what}: time ~ N^{exponent['seconds']}, memory ~ N^{exponent['peak_mb']}")
    recipes: dict[str, dict[str, float]] = {}
    for path in sorted((ROOT / "configs" / "exp").glob("*.yaml")):
        recipe = load_recipe(path, "laptop")
        if recipe.networks_of is None:
            arms = {arm: in_a_process(minutes_of, path, arm) for arm in recipe.arms}
            recipes[recipe.id] = arms
            print(f"minutes of {recipe.id} at laptop scale: {arms}", flush=True)
    RECORD.parent.mkdir(parents=True, exist_ok=True)
    about = machine()
    content = {**about, "rows": rows, "growth": growth, "exponents": exponents, "recipes": recipes}
    replace_json(RECORD, content)
    draw(growth, exponents, RECORD.with_name("growth.png"))
    print(f"written: {RECORD.relative_to(ROOT)}, growth.png")


def measure_registration() -> None:
    """Measure the rows of `corrmat register` alone, and put them into the record."""
    content = json.loads(RECORD.read_text())
    if {name: content[name] for name in machine()} != machine():
        sys.exit(f"{RECORD.relative_to(ROOT)} is of another machine: make bench measures all rows")
    for row in content["rows"]:
        if row["what"] in REGISTRATION:
            row |= in_a_process(REGISTRATION[row["what"]])
            print(row, flush=True)
    replace_json(RECORD, content)


def machine() -> dict[str, object]:
    """Return what times depend on."""
    return {
        "threads": torch.get_num_threads(),
        "instructions": torch.backends.cpu.get_cpu_capability(),
        "torch": torch.__version__,
    }


def step_name(method: str, hparams: dict[str, Any], n: int, batch: int) -> str:
    """Name a step of `STEPS`."""
    network = "shipped" if hparams is SHIPPED else "laptop" if hparams else "paper's"
    return f"{method}, {network} network, N={n}, batch {batch}"


def minutes_of(path: Path, arm: str) -> float:
    """Minutes that training an arm of a recipe takes, by its steps and validation batches."""
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    keep_freed_memory()
    settings = load_recipe(path, "laptop", arms=[arm]).arms[arm]
    ready = prepare(settings)
    module, trainer = fresh_method(settings), settings.trainer
    train, held_out = ready.datamodule.train_dataloader(), ready.datamodule.val_dataloader()
    adam = torch.optim.Adam(module.parameters(), 1e-4, fused=True)
    pairs, checked = iter(train), iter(held_out)

    def step() -> None:
        batch = next(pairs)
        adam.zero_grad()
        loss_of(module, batch).backward()
        torch.nn.utils.clip_grad_norm_(module.parameters(), trainer.gradient_clip_val)
        adam.step()

    @torch.no_grad()
    def check() -> None:
        batch = next(checked)
        module.metrics.update(module(batch.source, batch.target), batch)

    step_s, check_s = median([step], 15)[0], median([check], 3)[0]
    checks = trainer.max_steps / trainer.val_check_interval * trainer.limit_val_batches
    return round((trainer.max_steps * step_s + checks * check_s) / 60, 1)


def matmul_peak() -> Row:
    """What this machine's matrix products reach."""
    a, b = torch.randn(2, 2048, 2048)
    return {"gflops": round(2 * 2048**3 / median([lambda: a @ b], 9)[0] / 1e9)}


def pairs_a_second() -> Row:
    """Pairs a second on one core, identical sampling, N = 512."""
    torch.set_num_threads(1)
    clouds, settings = dataset.load("test", 32), PairSettings(num_points=512)
    keys = [Key(0, 0, 0, i) for i in range(16)]
    seconds = median([lambda: make_pairs(clouds, range(16), keys, settings)], 100)[0]
    return {"pairs_a_second": round(16 / seconds), "ms_a_pair": round(1e3 * seconds / 16, 3)}


def pairs_of_many_shapes() -> Row:
    """Pairs a second from 100,000 made-up shapes on disk, beside 4,000, and the process' memory.

    Shards hold one shape many times: what is measured is reading, not the shapes. The memory is
    the whole process', libraries included.
    """
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        works = [_pairs_of(Path(folder, str(count)), count) for count in (100_000, 4_000)]
        many, few = median(works, 100)
    return {
        "pairs_a_second": round(16 / many),
        "ms_a_pair": round(1e3 * many / 16, 3),
        "4000_shapes_ratio": round(few / many, 2),
        "peak_mb": round(peak_mb()),
    }


def _pairs_of(folder: Path, count: int) -> Callable[[], object]:
    """Write a data set of so many shapes; return what draws sixteen random pairs of it."""
    rows = dataset.load("test", 1).rows[np.arange(1)].repeat(1000, 0)
    for number in range(count // 1000):
        write_shard(folder, number, rows, np.zeros(1000, np.int64), [])
    finish_shards(folder, ["made-up"], count // 1000)
    pairs = PairDataset(open_shards(folder), PairSettings(num_points=512), 0, "train")
    sampler = iter(EpochSampler(len(pairs), seed=0, shuffle=True))
    return lambda: pairs.__getitems__([next(sampler) for _ in range(16)])


def training_step(method: str, hparams: dict[str, Any], n: int, batch: int) -> Row:
    """Milliseconds and billions of operations a pair of a training step."""
    pairs, module, step = build(method, hparams, n, batch)
    seconds = median([lambda: step(loss_of(module, pairs))], 3 if n * batch > 2000 else 20)[0]
    with FlopCounterMode(display=False) as counter:
        step(loss_of(module, pairs))
    return {
        "ms_a_pair": round(1e3 * seconds / batch, 1),
        "gflop_a_pair": counter.get_total_flops() / batch / 1e9,
    }


def peak_of_a_step(
    method: str, hparams: dict[str, Any], n: int, batch: int, loss: Callable[..., torch.Tensor]
) -> int:
    """Megabytes that two steps need above what was held before."""
    pairs, module, step = build(method, hparams, n, batch, keep=loss is loss_of)
    held = held_mb()
    for _ in range(2):
        step(loss(module, pairs))
    return round(peak_mb() - held)


def released_step(method: str, hparams: dict[str, Any], n: int, batch: int, keep: bool) -> float:
    """Milliseconds a pair of a step in the released formulation.

    Args:
        method: whose weights and loss.
        hparams: of its network.
        n: points of a cloud.
        batch: pairs.
        keep: whether glibc keeps freed blocks, as ours tells it to, or does as it comes.
    """
    pairs, module, step = build(method, hparams, n, batch, keep=keep)
    works = [lambda: step(released_loss(module, pairs))]
    return 1e3 * median(works, 3 if n * batch > 2000 else 20)[0] / batch


def against_compiled(method: str, hparams: dict[str, Any], n: int, batch: int) -> Row:
    """A training step of the network by torch.compile, and how many times longer it takes as is."""
    from torch._inductor import config  # takes seconds, and no other row needs it

    config.force_disable_caches = True
    pairs, module, step = build(method, hparams, n, batch)
    network = torch.compile(module.network, dynamic=False)

    def compiled() -> None:
        step(module.loss(network(pairs.source, pairs.target), pairs))

    (first,) = median([compiled], 1, warm=False)
    ours, eager = median([compiled, lambda: step(loss_of(module, pairs))], 9)
    return {
        "ms_a_pair": round(1e3 * ours / batch, 1),
        "eager_ratio": round(eager / ours, 2),
        "first_step_s": round(first),
    }


@torch.no_grad()
def inference(method: str) -> Row:
    """Milliseconds from one pair to its transform; also as released, where there is a twin."""
    pairs, module, _ = build(method, {}, 1024, 1)
    module.eval()
    both: list[Callable[[], object]] = [lambda: module(pairs.source, pairs.target)]
    if twin := RELEASED.get(type(module.network)):
        both.append(lambda: twin(module.network, pairs.source, pairs.target))
    ours, *other = median(both, 5)
    return {"ms": round(1e3 * ours, 1)} | (
        {"released_ratio": round(other[0] / ours, 2)} if other else {}
    )


def classical(name: str) -> Row:
    """Milliseconds of a classical pipeline on one pair; nothing where Open3D is missing."""
    pairs, *_ = build("PCRNet_corr", {}, 1024, 1)
    source, target = pairs.source[0].double().numpy(), pairs.target[0].double().numpy()
    try:
        return {"ms": round(1e3 * median([lambda: CLASSICAL[name](source, target, 0)], 5)[0], 1)}
    except CorrmatError as error:
        return {"not_measured": str(error)}


def registered_pair() -> Row:
    """Milliseconds of `corrmat.register` on `real` pairs: overlap, noise, outliers."""
    pairs = frozen_pairs(protocol="real", data="shapes", points=1024, root=None, count=12)
    clouds = zip(pairs.source.double().numpy(), pairs.target.double().numpy(), strict=True)
    works = [lambda x=x[:, :3], y=y[:, :3]: register(x, y) for x, y in clouds]
    return {"ms": round(1e3 * statistics.median(median(works, 3)), 1)}


def cold_start() -> Row:
    """Milliseconds of the whole command, imports included, and of importing torch alone."""
    with tempfile.TemporaryDirectory() as folder:
        write_example(Path(folder))
        scans = [str(Path(folder, f"{name}.ply")) for name in ("source", "target")]
        commands = ["-m", "corrmat", "register", *scans], ["-c", "import torch"]
        works = [
            lambda words=words: subprocess.run(
                [sys.executable, *words], check=True, stdout=subprocess.DEVNULL
            )
            for words in commands
        ]
        ours, torch_alone = median(works, 5)
    return {"ms": round(1e3 * ours), "import_torch_ms": round(1e3 * torch_alone)}


REGISTRATION = {
    "corrmat.register, two clouds of 1,024 points": registered_pair,
    "corrmat register, the example, from a cold start": cold_start,
}


def against_twin(name: str) -> Row:
    """How many times longer an operation's naive twin takes."""
    torch.manual_seed(0)
    fast, naive = TWINS[name]()
    ours, other = median([fast, naive], 5)
    return {"ms": round(1e3 * ours, 1), "naive_ratio": round(other / ours, 2)}


def _pulled(work: Callable[..., Any], *inputs: torch.Tensor) -> Callable[[], None]:
    leaves = [t.clone().requires_grad_() for t in inputs]

    def run() -> None:
        outputs = work(*leaves)
        outputs = outputs if isinstance(outputs, tuple) else (outputs,)
        torch.cat([t.flatten() for t in outputs]).sum().backward()

    return run


def _procrustes() -> tuple[Callable[[], object], ...]:
    x, y = torch.randn(2, 16, 512, 3)
    w = torch.rand(16, 512)
    return tuple(_pulled(work, x, y, w) for work in (procrustes, twins.procrustes_loop))


def _pair_features() -> tuple[Callable[[], object], ...]:
    offset, n, m = torch.nn.functional.normalize(torch.randn(3, 700, 256, 3), dim=-1)
    features = (signless_pair_features, twins.pair_features_as_written)
    return tuple(lambda work=work: work(offset, n[:, :1], m[:1]) for work in features)


def _ball_query() -> tuple[Callable[[], object], ...]:
    points = torch.rand(4, 1024, 3)
    queries = (within_radius, twins.ball_query_by_sorting)
    return tuple(lambda work=work: work(points, 0.3, 64) for work in queries)


def _chamfer() -> tuple[Callable[[], object], ...]:
    x, y = torch.rand(2, 8, 1024, 3)
    return tuple(_pulled(work, x, y) for work in (chamfer_loss, twins.chamfer_loss_dense))


def _sinkhorn() -> tuple[Callable[[], object], ...]:
    f_x, f_y = torch.nn.functional.normalize(torch.randn(2, 2, 1024, 96), dim=-1)
    beta, alpha = torch.full((2,), 5.0), torch.ones(2)

    def fast(f_x: torch.Tensor, f_y: torch.Tensor) -> torch.Tensor:
        return SinkhornCorrespondence(f_x, f_y, beta, alpha, 5, "row").weight()

    def naive(f_x: torch.Tensor, f_y: torch.Tensor) -> torch.Tensor:
        distance = (f_x.unsqueeze(2) - f_y.unsqueeze(1)).square().sum(-1)
        affinity = -beta[:, None, None] * (distance - alpha[:, None, None])
        return twins.sinkhorn_padded(affinity, 5, "row").exp().sum(2)

    return tuple(_pulled(work, f_x, f_y) for work in (fast, naive))


def _cross_entropy() -> tuple[Callable[[], object], ...]:
    f_x, f_y = torch.randn(2, 4, 1024, 512)
    match, scale = torch.arange(1024).expand(4, -1), 512**-0.5
    return (
        _pulled(lambda a, b: SoftCorrespondence(a, b, scale).nll(match), f_x, f_y),
        _pulled(lambda a, b: twins.cross_entropy_by_one_hot(a, b, scale, match), f_x, f_y),
    )


TWINS: dict[str, Callable[[], tuple[Callable[[], object], ...]]] = {
    "Procrustes, 16 pairs of 512, value and gradient": _procrustes,
    "pair features, 700 points to 256 anchors": _pair_features,
    "neighbours within a radius, 4 clouds of 1024": _ball_query,
    "Chamfer distance, 8 pairs of 1024, value and gradient": _chamfer,
    "Sinkhorn, 2 pairs of 1024, value and gradient": _sinkhorn,
    "cross-entropy, 4 pairs of 1024, d=512, value and gradient": _cross_entropy,
}


def against_dense(n: int) -> Row:
    """Milliseconds of loss, pose and gradient, how many times longer the whole matrix takes."""
    step = _loss_and_pose(n)

    def on(most: int) -> None:
        streaming._DENSE = most  # entries up to which the matrix is made whole
        step()

    ours, other = median([lambda: on(0), lambda: on(n * n)], 3)
    return {"ms": round(1e3 * ours, 1), "dense_ratio": round(other / ours, 2)}


def grown(what: str, n: int) -> Row:
    """Seconds and peak memory of one pair of N points."""
    if what == "loss and pose":
        run = _loss_and_pose(n)
    else:
        pairs, module, step = build(what.split(",")[0], {}, n, 1)

        def run() -> None:
            step(loss_of(module, pairs))

    held = held_mb()
    seconds = median([run], 1, warm=False)[0]
    used = peak_mb() - held  # of the first step, for large clouds as for small ones
    if n <= 4096:
        seconds = median([run], 3, warm=False)[0]
    return {"seconds": round(seconds, 4), "peak_mb": round(used)}


def _loss_and_pose(n: int) -> Callable[[], None]:
    torch.manual_seed(0)
    f_x, f_y = (torch.randn(1, n, 512).requires_grad_() for _ in range(2))
    y, match = torch.randn(1, n, 3), torch.arange(n).unsqueeze(0)

    def step() -> None:
        c = SoftCorrespondence(f_x, f_y, 512**-0.5)
        (c.soft_target(y).sum() + correspondence_loss(c, match)).backward()

    return step


def fitted(measured: list[Row]) -> dict[str, float | None]:
    """Exponents of time from N = 1024 on, of memory from 4096: there the matrix is streamed."""
    exponents: dict[str, float | None] = {}
    for name, least in (("seconds", 1024), ("peak_mb", 4096)):
        points = [(row["n"], row[name]) for row in measured if row[name] > 0 and row["n"] >= least]
        slope = np.polyfit(*np.log(points).T, 1)[0] if len(points) > 1 else None
        exponents[name] = None if slope is None else round(float(slope), 2)
    return exponents


def draw(growth: dict[str, list[Row]], exponents: dict[str, Any], path: Path) -> None:
    """Time and memory against N, on doubly logarithmic axes."""
    mpl.use("Agg")
    figure, panels = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
    for axes, name, title in zip(
        panels, ("seconds", "peak_mb"), ("seconds a pair", "peak memory, MB"), strict=True
    ):
        for (what, measured), colour in zip(growth.items(), (BLUE, RED, GREEN), strict=True):
            points = [(row["n"], row[name]) for row in measured if row[name] > 0]
            label = f"{what}: N^{exponents[what][name]}"
            axes.loglog(*zip(*points, strict=True), "o-", color=colour, label=label)
        # Slopes to compare with, through the lower left corner.
        (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
        n = np.geomspace(left, right)
        for power in (1, 2):
            label = f"N^{power}" if power > 1 else "N"
            axes.loglog(n, low * (n / left) ** power, ":", color="grey", zorder=0)
            end = min(right, left * (high / low) ** (1 / power))
            at = end, low * (end / left) ** power
            axes.annotate(
                label, at, (-4, -6), textcoords="offset points", ha="right", va="top", color="grey"
            )
        axes.set(xlim=(left, right), ylim=(low, high))
        axes.set(xlabel="points N of each cloud", title=title)
        axes.set_xticks(POINTS, [str(n) for n in POINTS], minor=False)
        axes.tick_params(axis="x", which="minor", bottom=False, labelbottom=False)
        axes.grid(alpha=0.3)
        axes.legend(frameon=False, fontsize=8)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def build(
    method: str, hparams: dict[str, Any], n: int, batch: int, keep: bool = True
) -> tuple[PairBatch, Any, Callable[[torch.Tensor], None]]:
    """Pairs of N points (of an ellipsoid if N is large), a method, a step of its optimizer."""
    torch.manual_seed(0)
    if keep:
        keep_freed_memory()
    module: Any = METHODS[method](hparams)
    if n <= dataset.load("test", 1).num_points:
        keys = [Key(0, 0, 0, i) for i in range(batch)]
        settings = PairSettings(num_points=n)
        pairs = make_pairs(dataset.load("test", batch), range(batch), keys, settings)
    else:
        cloud = torch.nn.functional.normalize(torch.randn(batch, n, 3), dim=-1)
        rows = torch.cat([cloud * torch.tensor([1.0, 0.7, 0.4]), cloud], -1)
        truth = torch.eye(3).expand(batch, 3, 3), torch.zeros(batch, 3)
        match = torch.arange(n).expand(batch, -1)
        pairs = PairBatch(rows, rows, *truth, match, rows[..., :3], torch.zeros(batch).long())
    adam = torch.optim.Adam(module.parameters(), 1e-4, fused=True)

    def step(loss: torch.Tensor) -> None:
        adam.zero_grad()
        loss.backward()
        adam.step()

    return pairs, module, step


def loss_of(module: Any, pairs: PairBatch) -> torch.Tensor:  # noqa: ANN401
    """The method's loss on these pairs."""
    return module.loss(module(pairs.source, pairs.target), pairs)


RELEASED: dict[type, Callable[..., tuple[Any, ...]]] = {
    DCPNetwork: twins.released_dcp,
    RPMNetwork: twins.released_rpmnet,
    PCRNetCorrNetwork: twins.released_pcrnet_corr,
}


def released_loss(module: Any, pairs: PairBatch) -> torch.Tensor:  # noqa: ANN401
    """The same of the same weights, in the released formulation."""
    *_, last = RELEASED[type(module.network)](module.network, pairs.source, pairs.target)
    matrices = last if isinstance(last, list | tuple) else [last]
    return torch.stack([twins.one_hot_loss(c, pairs.match) for c in matrices]).sum()


def in_a_process(work: Callable[..., Any], *arguments: Any) -> Any:  # noqa: ANN401
    """Run in a fresh process, whose peak of memory is its own."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(work, *arguments).result()


def held_mb() -> float:
    """Resident size of this process, in megabytes, from where on `peak_mb` counts."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")  # Linux: the peak so far is what is held now
    return peak_mb()


def peak_mb() -> float:
    """Largest resident size of this process, in megabytes."""
    status = Path("/proc/self/status")
    if status.is_file():  # Linux's ru_maxrss begins with the parent's, even in a fresh process
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) / 2**10
    size = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return size / 2**20 if sys.platform == "darwin" else size / 2**10


def median(works: Sequence[Callable[[], object]], repeats: int, warm: bool = True) -> list[float]:
    """Median seconds of each call, turn by turn, after one turn that does not count."""
    seconds: list[list[float]] = [[] for _ in works]
    for turn in range(repeats + warm):
        for work, times in zip(works, seconds, strict=True):
            start = time.perf_counter()
            work()
            if turn >= warm:
                times.append(time.perf_counter() - start)
    return [statistics.median(times) for times in seconds]


if __name__ == "__main__":
    if sys.argv[1:] not in ([], ["register"]):
        sys.exit(__doc__)
    measure_registration() if sys.argv[1:] else main()
