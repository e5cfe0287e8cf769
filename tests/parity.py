"""Small networks in the released formulation: `python tests/parity.py` writes tests/golden/.

The arrays are computed in float64 by the plain code of `twins.py`: no fused or streamed path.
Parameters are drawn by numpy's legacy generator, whose stream never changes, so they need no file.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
import twins
from conftest import random_rotation
from torch import Tensor, nn

from corrmat.networks.dcp import DCPNetwork
from corrmat.networks.pcrnet import PCRNetCorrNetwork, PCRNetwork
from corrmat.networks.rpmnet import RPMNetwork

GOLDEN = Path(__file__).parent / "golden"
EDGES = (8, 8, 16, 16)
NETWORKS: dict[str, Callable[[], nn.Module]] = {
    "dcp_identity": lambda: DCPNetwork(16, "identity", edge_channels=EDGES, k=6),
    "dcp_transformer": lambda: DCPNetwork(16, "transformer", 4, 24, EDGES, k=6),
    "rpmnet": lambda: RPMNetwork(8, k=6, radius=0.8, test_iterations=2, annealing_width=16),
    "rpmnet_both_slacks": lambda: RPMNetwork(
        8, k=6, radius=0.8, test_iterations=2, slack="both", annealing_width=16
    ),
    "pcrnet": lambda: PCRNetwork(16, iterations=4),
    "pcrnet_corr": lambda: PCRNetCorrNetwork(16),
}


def network(name: str) -> nn.Module:
    """Build a network in float64; every number of its state is drawn anew."""
    draws = np.random.RandomState(0)
    module = NETWORKS[name]().double()
    with torch.no_grad():
        for key, tensor in module.state_dict().items():
            if not tensor.is_floating_point():
                continue
            noise = torch.from_numpy(draws.uniform(-1, 1, tensor.shape))
            scale = 1 / tensor[0].numel() ** 0.5 if tensor.dim() > 1 else 0.2
            around_one = key.endswith(("var", "gain")) or ("weight" in key and tensor.dim() == 1)
            tensor.copy_(noise * scale + float(around_one))
        if name == "pcrnet":  # near the identity pose, as it is initialised
            module.pose[-1].bias += torch.tensor([1.0, 0, 0, 0, 0, 0, 0])
    return module.eval()


def pairs() -> dict[str, Tensor]:
    """Draw two pairs of 20 and 24 points with normals: source i is target `match[i]`, moved."""
    draws = np.random.RandomState(1)
    target = torch.from_numpy(draws.uniform(-1, 1, (2, 24, 6)))
    target[..., 3:] /= target[..., 3:].norm(dim=-1, keepdim=True)
    match = torch.from_numpy(np.stack([draws.permutation(24)[:20] for _ in range(2)]))
    rotation = random_rotation(2, torch.Generator().manual_seed(0))
    translation = torch.from_numpy(draws.uniform(-0.5, 0.5, (2, 3)))
    matched = torch.stack([y[i] for y, i in zip(target, match, strict=True)])
    source = torch.cat(
        [(matched[..., :3] - translation.unsqueeze(1)) @ rotation, matched[..., 3:] @ rotation], 2
    )
    return {
        "source": source, "target": target, "match": match,
        "rotation": rotation, "translation": translation,
    }  # fmt: skip


def released(name: str, module: nn.Module, arrays: dict[str, Tensor]) -> dict[str, Tensor]:
    """Compute pose, matrices and losses as released."""
    source, target, match = arrays["source"], arrays["target"], arrays["match"]
    if name == "pcrnet":
        rotation, translation = twins.released_pcrnet(module, source, target)
        moved = source[..., :3] @ rotation.mT + translation.unsqueeze(1)
        losses = {"loss_chamfer": twins.chamfer_loss_dense(moved, target[..., :3])}
        matrices = []
    elif name.startswith("rpmnet"):
        rotation, translation, matrices = twins.released_rpmnet(module, source, target)
        first, last = (twins.one_hot_loss(c, match) for c in matrices)
        losses = {"loss_correspondence": 0.5 * first + last}
    else:
        forward = twins.released_dcp if name.startswith("dcp") else twins.released_pcrnet_corr
        rotation, translation, c = forward(module, source, target)
        matrices = [c]
        identity = torch.eye(3).to(rotation)
        losses = {
            "loss_correspondence": twins.one_hot_loss(c, match),
            "loss_transformation": ((rotation.mT @ arrays["rotation"] - identity) ** 2).mean()
            + ((translation - arrays["translation"]) ** 2).mean(),
        }
    return {
        "rotation_pred": rotation, "translation_pred": translation, **losses,
        **{f"correspondence_{i}": c for i, c in enumerate(matrices)},
    }  # fmt: skip


def sample(gradient: Tensor) -> Tensor:
    """Take up to 128 or so numbers of a gradient, evenly spread."""
    return gradient.flatten()[:: max(1, gradient.numel() // 128)]


def main() -> None:
    """Write the arrays of every network: evaluation mode, then training mode with gradients."""
    GOLDEN.mkdir(exist_ok=True)
    for name in NETWORKS:
        module, arrays = network(name), pairs()
        with torch.no_grad():
            arrays |= released(name, module, arrays)
        in_training = released(name, module.train(), arrays)
        losses = {f"train_{key}": v for key, v in in_training.items() if key.startswith("loss")}
        next(iter(losses.values())).backward()
        gradients = {f"grad/{key}": sample(p.grad) for key, p in module.named_parameters()}
        arrays = {key: v.detach().numpy() for key, v in {**arrays, **losses, **gradients}.items()}
        np.savez_compressed(GOLDEN / f"{name}.npz", **arrays)


if __name__ == "__main__":
    main()
