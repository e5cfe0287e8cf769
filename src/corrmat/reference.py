"""The original authors' networks: their parameters' names, and the options that they leave out."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from corrmat.errors import CorrmatError
from corrmat.networks.dcp import DCPNetwork
from corrmat.networks.pcrnet import PCRNetCorrNetwork, PCRNetwork
from corrmat.networks.rpmnet import RPMNetwork
from corrmat.networks.state import State, load_state

# The original authors' names to ours, rewritten in this order.
_RULES: dict[str, tuple[tuple[str, str], ...]] = {
    "dcp": (
        (r"^emb_nn\.conv5\.", "embed.fuse."),
        (r"^emb_nn\.bn5\.", "embed.norm."),
        *((rf"^emb_nn\.conv{i + 1}\.", f"embed.edge.{i}.linear.") for i in range(4)),
        *((rf"^emb_nn\.bn{i + 1}\.", f"embed.edge.{i}.norm.") for i in range(4)),
        (r"^pointer\.model\.(en|de)coder\.norm\.", r"pointer.\1coder_norm."),
        (r"^pointer\.model\.(en|de)coder\.layers\.0\.", r"pointer.\1coder."),
        (r"self_attn\.", "self_attention."),
        (r"src_attn\.", "cross_attention."),
        (r"linears\.0\.", "query."),
        (r"linears\.1\.", "key."),
        (r"linears\.2\.", "value."),
        (r"linears\.3\.", "out."),
        (r"feed_forward\.w_1\.", "feedforward.0."),
        (r"feed_forward\.w_2\.", "feedforward.2."),
        (r"sublayer\.(\d)\.norm\.", r"norms.\1."),
        (r"a_2$", "gain"),
        (r"b_2$", "bias"),
    ),
    "rpmnet": (
        (r"^feat_extractor\.prepool\.", "embed.edge."),
        (r"^feat_extractor\.postpool\.6\.", "embed.out."),
        (r"^feat_extractor\.postpool\.", "embed.point."),
        (r"^weights_net\.prepool\.", "annealing.point."),
        (r"^weights_net\.postpool\.", "annealing.pooled."),
    ),
    # PointNet's five layers: linear and ReLU, or linear, batch norm and ReLU.
    "pcrnet": (
        *((rf"^feature_model\.conv{i + 1}\.", f"embed.layers.{2 * i}.") for i in range(5)),
        (r"^linear\.", "pose."),
    ),
    "pcrnet_corr": (
        *((rf"^emb_nn\.conv{i + 1}\.", f"embed.layers.{3 * i}.") for i in range(5)),
        *((rf"^emb_nn\.bn{i + 1}\.", f"embed.layers.{3 * i + 1}.") for i in range(5)),
    ),
}
_IGNORED = ("head.reflect",)  # a constant of the originals' SVD head


def load_reference(kind: str, state_dict: Mapping[str, Any], **hparams: Any) -> nn.Module:  # noqa: ANN401
    """Build a network from the original authors' parameters.

    Args:
        kind: "dcp", "rpmnet", "pcrnet" or "pcrnet_corr".
        state_dict: their names to tensors or arrays.
        hparams: the original's hyper-parameters. dcp: emb_dims, n_heads, ff_dims, k, pointer.
            rpmnet: feat_dim, num_neighbors, radius, num_iter, num_sk_iter, slack.
            pcrnet: emb_dims, iterations. pcrnet_corr: emb_dims.
            Sizes default to what the tensors say; `notes` and the like are ignored.

    Returns:
        The network in evaluation mode.

    Raises:
        CorrmatError: unknown kind, or the parameters do not fit; the message lists them.
    """
    if kind not in _BUILD:
        raise CorrmatError(f"no reference network of kind {kind!r}; kinds: {', '.join(_BUILD)}")
    ours = {
        rename(kind, name): torch.as_tensor(value)
        for name, value in state_dict.items()
        if name not in _IGNORED
    }
    return load_state(_BUILD[kind](ours, hparams), ours)


def kind_of(path: Path, state: State) -> str:
    """Recognise the original authors' network by the names of its parameters."""
    if "feat_extractor.prepool.0.weight" in state:
        return "rpmnet"
    if "feature_model.conv1.weight" in state:
        return "pcrnet"
    first = state.get("emb_nn.conv1.weight")
    if first is not None and first.ndim > 1:
        return "dcp" if first.shape[1] == 6 else "pcrnet_corr"
    names = ", ".join(sorted(state)[:4])
    raise CorrmatError(
        f"{path} is none of DCP, RPMNet, PCRNet and PCRNet_corr; its parameters: {names}, ..."
    )


def rename(kind: str, name: str) -> str:
    """Translate the name of one of the original's parameters to ours."""
    for pattern, replacement in _RULES[kind]:
        name = re.sub(pattern, replacement, name)
    return name


def _dcp(state: State, hparams: dict[str, Any]) -> nn.Module:
    """Build DCP for a state; sizes default to the tensors'."""
    fuse = _required(state, "embed.fuse.weight", "a DCP", "emb_nn.conv5.weight")
    hidden = state.get("pointer.encoder.feedforward.0.weight")
    return DCPNetwork(
        width=hparams.get("emb_dims", len(fuse)),
        pointer=hparams.get("pointer", "identity" if hidden is None else "transformer"),
        heads=hparams.get("n_heads", 4),
        feedforward=hparams.get("ff_dims", 1024 if hidden is None else len(hidden)),
        k=hparams.get("k", 20),
    )


def _rpmnet(state: State, hparams: dict[str, Any]) -> nn.Module:
    """Build RPMNet for a state; sizes default to the tensors'."""
    out = _required(state, "embed.out.weight", "an RPMNet", "feat_extractor.postpool.6.weight")
    iterations = hparams.get("num_iter")
    slack = str(hparams.get("slack", "both")).split()[0]  # RPM-Net's default; a remark may follow
    return RPMNetwork(
        width=hparams.get("feat_dim", len(out)),
        k=hparams.get("num_neighbors", 64),
        radius=hparams.get("radius", 0.3),
        iterations=iterations or 2,
        test_iterations=iterations or 5,
        sinkhorn_iterations=hparams.get("num_sk_iter", 5),
        slack=slack,  # type: ignore[arg-type]
    )


def _pcrnet(state: State, hparams: dict[str, Any]) -> nn.Module:
    last = _required(state, "embed.layers.8.weight", "a PCRNet", "feature_model.conv5.weight")
    return PCRNetwork(hparams.get("emb_dims", len(last)), hparams.get("iterations", 8))


def _pcrnet_corr(state: State, hparams: dict[str, Any]) -> nn.Module:
    last = _required(state, "embed.layers.12.weight", "a PCRNet_corr", "emb_nn.conv5.weight")
    return PCRNetCorrNetwork(hparams.get("emb_dims", len(last)))


_BUILD: dict[str, Callable[[State, dict[str, Any]], nn.Module]] = {
    "dcp": _dcp,
    "rpmnet": _rpmnet,
    "pcrnet": _pcrnet,
    "pcrnet_corr": _pcrnet_corr,
}


def _required(state: State, name: str, what: str, theirs: str) -> Tensor:
    if name not in state:
        raise CorrmatError(f"not {what} checkpoint: {theirs} is missing")
    return state[name]
