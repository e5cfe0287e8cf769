"""Trained networks: the shipped one, this project's checkpoints, and the original authors'.

Nothing here executes what a file says: tensors are read by safetensors or by torch's loader for
weights only, which refuses every other kind of object.
"""

import json
import pickle
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch
import yaml
from torch import Tensor, nn

from corrmat.errors import CorrmatError
from corrmat.networks.dcp import DCPNetwork
from corrmat.networks.invariant import InvariantNetwork
from corrmat.networks.pcrnet import PCRNetCorrNetwork, PCRNetwork
from corrmat.networks.rpmnet import RPMNetwork

State = dict[str, Tensor]

# Their names to ours, rewritten in this order.
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
_LEFT_OUT = ("head.reflect",)  # a constant of the originals' SVD head


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
        raise CorrmatError(f"no reference network of kind {kind!r}; known: {', '.join(_BUILD)}")
    ours = {
        rename(kind, name): torch.as_tensor(value)
        for name, value in state_dict.items()
        if name not in _LEFT_OUT
    }
    return _filled(_BUILD[kind](ours, hparams), ours)


SHIPPED = Path(__file__).parent / "shipped" / "corrmat.safetensors"


def load_model(model: str | Path = "corrmat") -> nn.Module:
    """A trained network, in evaluation mode.

    Args:
        model: "corrmat" for the weights that ship with the package; or a file: a checkpoint of
            `corrmat fit` (with its settings.yaml beside it), or the original authors' .t7 or
            .pth of DCP, RPMNet, PCRNet or PCRNet_corr.

    Raises:
        CorrmatError: there is no such file, it holds anything but tensors, or they fit no
            network; the message says which do not.
    """
    if str(model) == "corrmat":
        network = InvariantNetwork(**json.loads(shipped_about()["network"]))
        return _filled(network, safetensors.torch.load_file(SHIPPED))
    path = Path(model)
    state = _tensors(path)
    if state and all(name.startswith("network.") for name in state):
        return own_checkpoint(path)[2]
    return load_reference(_kind_of(path, state), state)


def shipped_about() -> dict[str, str]:
    """What the shipped weights say of themselves: method, network, commit, calibration."""
    with safetensors.safe_open(SHIPPED, framework="pt") as file:
        return file.metadata()


def _tensors(path: Path) -> State:
    if not path.is_file():
        raise CorrmatError(
            f"no model {str(path)!r}: neither corrmat, icp, ransac, fgr nor a checkpoint file"
        )
    try:
        found = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise CorrmatError(
            f"{path} is no checkpoint of tensors alone; nothing else is ever loaded"
        ) from error
    # Unpicklers fail in every way there is on a file that is none of theirs.
    except Exception as error:
        raise CorrmatError(f"{path} is no checkpoint, or cut short") from error
    for key in ("state_dict", "model", "model_state_dict"):
        if isinstance(found, Mapping) and isinstance(found.get(key), Mapping):
            found = found[key]
    if not isinstance(found, Mapping) or not found:
        raise CorrmatError(f"{path} holds no parameters by name")
    tensors = {str(k): v for k, v in found.items() if isinstance(v, Tensor)}
    return {name.removeprefix("module."): value for name, value in tensors.items()}


def own_checkpoint(path: Path) -> tuple[str, dict[str, Any], nn.Module]:
    """Method, hyper-parameters and network of a checkpoint of `corrmat fit`.

    Raises:
        CorrmatError: settings.yaml is not beside it, or it does not fit.
    """
    from corrmat.methods import METHODS  # brings Lightning, for which register does not wait

    settings = path.parent / "settings.yaml"
    if not settings.is_file():
        raise CorrmatError(f"{path} is a checkpoint of corrmat, but {settings} is not beside it")
    try:
        about = yaml.safe_load(settings.read_text())
        method, hparams = about["method"], about["network"]
        network = METHODS[method].network_type(**hparams)
    except (yaml.YAMLError, KeyError, TypeError, ValueError) as error:
        raise CorrmatError(f"{settings} does not say which network {path} is of") from error
    own = {
        name.removeprefix("network."): value
        for name, value in _tensors(path).items()
        if name.startswith("network.")
    }
    return method, hparams, _filled(network, own)


def _kind_of(path: Path, state: State) -> str:
    if "feat_extractor.prepool.0.weight" in state:
        return "rpmnet"
    if "feature_model.conv1.weight" in state:
        return "pcrnet"
    first = state.get("emb_nn.conv1.weight")
    if first is not None:
        return "dcp" if first.shape[1] == 6 else "pcrnet_corr"
    names = ", ".join(sorted(state)[:4])
    raise CorrmatError(
        f"{path} is none of DCP, RPMNet, PCRNet and PCRNet_corr; its parameters: {names}, ..."
    )


def rename(kind: str, name: str) -> str:
    """What one of the original's parameters is called here."""
    for pattern, replacement in _RULES[kind]:
        name = re.sub(pattern, replacement, name)
    return name


def _dcp(state: State, hparams: dict[str, Any]) -> nn.Module:
    fuse = _known(state, "embed.fuse.weight", "a DCP", "emb_nn.conv5.weight")
    hidden = state.get("pointer.encoder.feedforward.0.weight")
    return DCPNetwork(
        width=hparams.get("emb_dims", len(fuse)),
        pointer=hparams.get("pointer", "identity" if hidden is None else "transformer"),
        heads=hparams.get("n_heads", 4),
        feedforward=hparams.get("ff_dims", 1024 if hidden is None else len(hidden)),
        k=hparams.get("k", 20),
    )


def _rpmnet(state: State, hparams: dict[str, Any]) -> nn.Module:
    out = _known(state, "embed.out.weight", "an RPMNet", "feat_extractor.postpool.6.weight")
    turns = hparams.get("num_iter")
    slack = str(hparams.get("slack", "both")).split()[0]  # RPM-Net's own; a remark may follow
    return RPMNetwork(
        width=hparams.get("feat_dim", len(out)),
        k=hparams.get("num_neighbors", 64),
        radius=hparams.get("radius", 0.3),
        iterations=turns or 2,
        test_iterations=turns or 5,
        sinkhorn_iterations=hparams.get("num_sk_iter", 5),
        slack=slack,  # type: ignore[arg-type]
    )


def _pcrnet(state: State, hparams: dict[str, Any]) -> nn.Module:
    last = _known(state, "embed.layers.8.weight", "a PCRNet", "feature_model.conv5.weight")
    return PCRNetwork(hparams.get("emb_dims", len(last)), hparams.get("iterations", 8))


def _pcrnet_corr(state: State, hparams: dict[str, Any]) -> nn.Module:
    last = _known(state, "embed.layers.12.weight", "a PCRNet_corr", "emb_nn.conv5.weight")
    return PCRNetCorrNetwork(hparams.get("emb_dims", len(last)))


_BUILD: dict[str, Callable[[State, dict[str, Any]], nn.Module]] = {
    "dcp": _dcp,
    "rpmnet": _rpmnet,
    "pcrnet": _pcrnet,
    "pcrnet_corr": _pcrnet_corr,
}


def _known(state: State, name: str, what: str, theirs: str) -> Tensor:
    if name not in state:
        raise CorrmatError(f"not {what} checkpoint: {theirs} is missing")
    return state[name]


def _filled(network: nn.Module, state: State) -> nn.Module:
    expected = network.state_dict()
    wrong = [f"{name} is missing" for name in expected if name not in state]
    wrong += [f"{name} is unknown" for name in state if name not in expected]
    wrong += [
        f"{name} is {_shape(state[name])}, not {_shape(tensor)}"
        for name, tensor in expected.items()
        if name in state and _shape(state[name]) != _shape(tensor)
    ]
    if wrong:
        shown = "; ".join(wrong[:8]) + (f"; and {len(wrong) - 8} more" if len(wrong) > 8 else "")
        raise CorrmatError(f"the checkpoint does not fit: {shown}")
    network.load_state_dict({name: state[name].view_as(own) for name, own in expected.items()})
    return network.eval()


def _shape(tensor: Tensor) -> tuple[int, ...]:
    """Without the ones at the end, by which a 1 x 1 convolution differs from a linear layer."""
    shape = list(tensor.shape)
    while shape and shape[-1] == 1:
        shape.pop()
    return tuple(shape)
