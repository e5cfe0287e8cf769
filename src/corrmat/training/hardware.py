"""What an arm trains on: device, number format, memory, and Lightning's Trainer for it."""

import contextlib
import ctypes

import torch
from lightning.pytorch.plugins.precision import MixedPrecision, Precision
from lightning.pytorch.utilities import GradClipAlgorithmType, rank_zero_only
from torch.optim import Optimizer

from corrmat.training.callbacks import AtomicCheckpointIO
from corrmat.training.recipe import ArmSettings

_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # of glibc's malloc.h
Devices = int | str | list[int]


class Bfloat16(MixedPrecision):
    """Autocast to bfloat16 that allows clipping gradients with a fused optimizer.

    Lightning refuses this for every mixed precision, because a fused step may have to undo a
    gradient scale first; bfloat16 gradients are not scaled.
    """

    def __init__(self, device: str) -> None:
        super().__init__("bf16-mixed", device)

    def clip_gradients(
        self,
        optimizer: Optimizer,
        clip_val: float = 0.0,
        gradient_clip_algorithm: GradClipAlgorithmType = GradClipAlgorithmType.NORM,
    ) -> None:
        """Clip gradients as in full precision."""
        Precision.clip_gradients(self, optimizer, clip_val, gradient_clip_algorithm)


def trainer_options(settings: ArmSettings, precision: str | None = None) -> dict[str, object]:
    """Return keyword arguments of Lightning's Trainer.

    Args:
        settings: of the arm.
        precision: instead of the settings' precision.
    """
    options: dict[str, object] = settings.trainer.as_dict()
    plugins: list[object] = [AtomicCheckpointIO()]
    accelerator = str(options["accelerator"])
    if accelerator == "auto" and torch.backends.mps.is_available():
        accelerator = "cpu"  # Apple's GPUs lack the float64 that Procrustes needs
    precision = precision or resolve_precision(settings)
    if precision == "bf16-mixed" and "fsdp" not in str(options["strategy"]):
        plugins.append(Bfloat16("cuda" if on_gpu(accelerator) else "cpu"))
        precision = None  # the plugin's
    return options | {
        "accelerator": accelerator,
        "precision": precision,
        "plugins": plugins,
        "enable_model_summary": False,
        "enable_checkpointing": True,
        "enable_progress_bar": bool(options.get("enable_progress_bar")),  # default: the board
        "use_distributed_sampler": False,  # `EpochSampler` splits pairs over processes
    }


def on_gpu(accelerator: str) -> bool:
    """Tell whether this accelerator, by Lightning's name, is a CUDA GPU here."""
    return torch.cuda.is_available() and accelerator in ("auto", "gpu", "cuda")


def resolve_precision(settings: ArmSettings) -> str:
    """Return the precision that an arm trains in, by Lightning's name."""
    precision = str(settings.trainer.precision)
    return fast_precision(settings.trainer.accelerator) if precision == "auto" else precision


def fast_precision(accelerator: str) -> str:
    """Return "bf16-mixed" where the machine has instructions for bfloat16, else "32-true".

    Logits, moments, Procrustes and losses stay in float32 or wider, and so do all tests.

    Args:
        accelerator: as Lightning's Trainer takes it.
    """
    if on_gpu(accelerator):
        fast = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        fast = getattr(torch.cpu, "get_capabilities", dict)().get("avx512_bf16", False)
    return "bf16-mixed" if fast else "32-true"


def describe_hardware(settings: ArmSettings) -> dict[str, object]:
    """Describe what an arm trains on, for its record."""
    return {
        "threads": torch.get_num_threads(),
        "gpu": on_gpu(settings.trainer.accelerator),
        "precision": resolve_precision(settings),
    }


def keep_freed_memory() -> None:
    """Tell glibc to keep the blocks that a training step frees for the next step.

    Otherwise it returns large blocks to the kernel, which clears them anew for every step: up to
    a quarter of a CPU step. There is no effect with another C library.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):
        library = ctypes.CDLL(None)
        library.mallopt(_M_MMAP_MAX, 0)
        library.mallopt(_M_TRIM_THRESHOLD, -1)  # never


def flush_denormals() -> None:
    """Let numbers below 1e-38 be zero: many CPUs compute far slower with them.

    DCP's attention makes them where it is sharp. Torch's threads take this over from the one that
    starts them, so it comes before the first operation that needs them, and is for good.
    """
    torch.set_flush_denormal(True)


def is_first_process() -> bool:
    """Tell whether this process writes: the only one, or the first of those that train together."""
    return not rank_zero_only.rank


def first_device(devices: Devices) -> int | list[int]:
    """Return one device: the first of those that settings name, as a list or as "2,3", or any."""
    if isinstance(devices, str) and "," in devices:
        return [int(devices.partition(",")[0])]
    return devices[:1] if isinstance(devices, list) else 1
