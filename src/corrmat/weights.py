"""Checkpoints of the original authors, under the names that this project gives their layers."""

import re
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from corrmat.errors import CorrmatError
from corrmat.networks.dcp import DCPNetwork

# Rewritten in this order; the first group of rules is DGCNN's, the second the transformer's.
_DCP_RULES: tuple[tuple[str, str], ...] = (
    (r"^emb_nn\.conv5\.", "embed.fuse."),
    (r"^emb_nn\.bn5\.", "embed.norm."),
    (r"^emb_nn\.conv(\d)\.", r"embed.edge.#\1.linear."),
    (r"^emb_nn\.bn(\d)\.", r"embed.edge.#\1.norm."),
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
)
_DCP_LEFT_OUT = ("head.reflect",)  # a constant of the original's SVD head


def load_reference(kind: str, state_dict: Mapping[str, Any], **hparams: Any) -> nn.Module:  # noqa: ANN401
    """Build a network from the original authors' parameters.

    Args:
        kind: "dcp".
        state_dict: their names to tensors or arrays.
        hparams: the original's hyper-parameters: emb_dims, n_heads, ff_dims, k, pointer.
            Sizes default to what the tensors say; `notes` and the like are ignored.

    Returns:
        The network in evaluation mode.

    Raises:
        CorrmatError: unknown kind, or the parameters do not fit; the message lists them.
    """
    if kind != "dcp":
        raise CorrmatError(f"no reference network of kind {kind!r}; known: dcp")
    return _load_dcp(state_dict, hparams)


def rename_dcp(name: str) -> str:
    """The name in `DCPNetwork` of one of the original DCP's parameters."""
    for pattern, replacement in _DCP_RULES:
        name = re.sub(pattern, replacement, name)
    return re.sub(r"#(\d)", lambda found: str(int(found[1]) - 1), name)


def _load_dcp(state_dict: Mapping[str, Any], hparams: dict[str, Any]) -> nn.Module:
    ours = {
        rename_dcp(name): _squeezed(value)
        for name, value in state_dict.items()
        if name not in _DCP_LEFT_OUT
    }
    fuse = ours.get("embed.fuse.weight")
    if fuse is None:
        raise CorrmatError("not a DCP checkpoint: emb_nn.conv5.weight is missing")
    hidden = ours.get("pointer.encoder.feedforward.0.weight")
    network = DCPNetwork(
        width=hparams.get("emb_dims", len(fuse)),
        pointer=hparams.get("pointer", "identity" if hidden is None else "transformer"),
        heads=hparams.get("n_heads", 4),
        feedforward=hparams.get("ff_dims", 1024 if hidden is None else len(hidden)),
        k=hparams.get("k", 20),
    )
    return _filled(network, ours)


def _filled(network: nn.Module, state: dict[str, Tensor]) -> nn.Module:
    expected = network.state_dict()
    wrong = [f"{name} is missing" for name in expected if name not in state]
    wrong += [f"{name} is unknown" for name in state if name not in expected]
    wrong += [
        f"{name} is {tuple(state[name].shape)}, not {tuple(tensor.shape)}"
        for name, tensor in expected.items()
        if name in state and state[name].shape != tensor.shape
    ]
    if wrong:
        shown = "; ".join(wrong[:8]) + (f"; and {len(wrong) - 8} more" if len(wrong) > 8 else "")
        raise CorrmatError(f"the checkpoint does not fit: {shown}")
    network.load_state_dict(state)
    return network.eval()


def _squeezed(value: Any) -> Tensor:  # noqa: ANN401
    """1 x 1 convolutions are linear layers here."""
    tensor = torch.as_tensor(value)
    return tensor.flatten(1) if tensor.ndim > 2 else tensor
