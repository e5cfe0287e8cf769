"""Trained networks: the shipped one, this project's checkpoints, and the original authors'.

Nothing here executes code from a file: tensors are read by safetensors, or by torch's loader for
weights only, which refuses every other kind of object.
"""

import importlib
import json
import pickle
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import safetensors
import safetensors.torch
import torch
from torch import Tensor, nn

from corrmat.errors import CorrmatError
from corrmat.files import refuse_existing, replace_bytes
from corrmat.networks.invariant import InvariantNetwork
from corrmat.networks.state import State, load_state
from corrmat.networks.verification import VerificationNetwork
from corrmat.reference import kind_of, load_reference

_MODEL_FILE = "model.safetensors"  # of a folder, as the Hugging Face Hub has it
_FRONT = "---\nlibrary_name: corrmat\nlicense: mit\ntags: [point-cloud-registration]\n---\n\n"
SHIPPED = Path(__file__).parent / "shipped" / "corrmat.safetensors"


def shipped_models() -> list[str]:
    """List the trained arms of experiments that ship with the package, e.g. "1.2/DCP_corr"."""
    files = SHIPPED.parent.glob("*/*.safetensors")
    return sorted(file.relative_to(SHIPPED.parent).with_suffix("").as_posix() for file in files)


def load_model(model: str | Path = "corrmat") -> nn.Module:
    """Load a trained network, in evaluation mode.

    Args:
        model: "corrmat" for the weights that `corrmat register` uses; one of `shipped_models`,
            e.g. "1.2/DCP_corr"; a folder that `export_model` has written, or "hf:name/model" for
            one on the Hugging Face Hub; or a file: a checkpoint of `corrmat fit`, or the original
            authors' .t7 or .pth of DCP, RPMNet, PCRNet or PCRNet_corr.

    Raises:
        CorrmatError: there is no such file, it holds anything but tensors, or they fit no
            network; the message names those that do not.
    """
    file = _safetensors_file(str(model))
    if file is not None:
        network = _load_safetensors(file)
        if isinstance(network, VerificationNetwork):
            raise CorrmatError(f"{model} judges candidates of corrmat; it registers nothing alone")
        return network
    path = Path(model)
    content = _read_checkpoint(path)
    if "method" in content:
        return _network_of(path, content)[2]
    state = _tensors(path, content)
    return load_reference(kind_of(path, state), state)


def load_verification(matching: nn.Module) -> VerificationNetwork | None:
    """Load the shipped verification network, if it was trained with this matching network."""
    path = _shipped_file("verification")
    if not path.is_file() or shipped_metadata("verification")["verifies"] != checksum(matching):
        return None
    network = _load_safetensors(path)
    assert isinstance(network, VerificationNetwork)
    return network


def checksum(network: nn.Module) -> str:
    """Compute the CRC-32 of a network's tensors."""
    value = 0
    for tensor in network.state_dict().values():
        content = tensor.cpu().contiguous().flatten().view(torch.uint8)  # NumPy knows no bfloat16
        value = zlib.crc32(content.numpy(), value)
    return f"{value:08x}"


def shipped_metadata(model: str = "corrmat") -> dict[str, str]:
    """Read the header of shipped weights: method, network, commit, and what goes with them.

    Args:
        model: "corrmat" (with its calibration), or one of `shipped_models` (with its record).
    """
    with safetensors.safe_open(_shipped_file(model), framework="pt") as file:
        return file.metadata()


def export_model(model: str | Path, folder: str | Path) -> None:
    """Write weights as a folder that the Hugging Face Hub understands.

    They are model.safetensors, config.json and a model card, README.md.

    Args:
        model: "corrmat", one of `shipped_models`, or a checkpoint of `corrmat fit`.
        folder: to write into; it is made.

    Raises:
        CorrmatError: there are no such weights, or they are an exported model; the folder holds
            files of these names already.
    """
    model, folder = str(model), Path(folder)
    if model == "corrmat" or model in shipped_models():
        about, content = shipped_metadata(model), _shipped_file(model).read_bytes()
        card = _model_card(model, about)
    elif model.startswith("hf:") or _safetensors_file(model):
        raise CorrmatError(f"{model} is an exported model already")
    else:
        name, hparams, network = checkpoint_network(Path(model))
        from corrmat.methods import METHODS  # imports Lightning, as `checkpoint_network` does

        method = next(key for key, cls in METHODS.items() if cls.__name__ == name)
        about = {"method": method, "network": json.dumps(hparams)}
        content = _to_safetensors(network, about)
        card = _FRONT + f"# {method}\n\n    network = corrmat.load_model(folder)\n"
    config = {"library_name": "corrmat", **about, "network": json.loads(about["network"])}
    files = {
        _MODEL_FILE: content,
        "config.json": (json.dumps(config, indent=1, sort_keys=True) + "\n").encode(),
        "README.md": card.encode(),
    }
    refuse_existing(folder / name for name in files)
    folder.mkdir(parents=True, exist_ok=True)
    for name, written in files.items():
        replace_bytes(folder / name, written)


def _to_safetensors(network: nn.Module, metadata: Mapping[str, str]) -> bytes:
    state = {name: tensor.contiguous() for name, tensor in network.state_dict().items()}
    return safetensors.torch.save(state, dict(metadata))


def _model_card(model: str, about: Mapping[str, str]) -> str:
    """Write the card of a shipped model, with the Hub's metadata in front."""
    if model == "corrmat":
        return _FRONT + (SHIPPED.parent / "MODEL_CARD.md").read_text("utf-8")
    return (
        f"{_FRONT}# {model}\n\n{about['method']} of experiment {model.split('/')[0]} of "
        f"*Correspondence Matrices are Underrated* (3DV 2020), reproduced. Its record: "
        f"results/{about['record']}, commit {about['commit']}.\n\n"
        "    network = corrmat.load_model(folder)\n"
    )


def _safetensors_file(model: str) -> Path | None:
    """Find the safetensors file of a model: shipped, exported or on the Hub; None for others."""
    if model == "corrmat" or model in shipped_models():
        return _shipped_file(model)
    if model.startswith("hf:"):
        return _download(model.removeprefix("hf:"))
    path = Path(model)
    exported = path if path.suffix == ".safetensors" else path / _MODEL_FILE
    return exported if exported.is_file() else None


def _download(repository: str) -> Path:
    """Download a model from the Hugging Face Hub, or find it in the Hub's cache."""
    try:
        hub = importlib.import_module("huggingface_hub")
    except ImportError as error:
        raise CorrmatError(f"hf: models need pip install huggingface_hub ({error})") from error
    try:
        return Path(hub.hf_hub_download(repository, _MODEL_FILE))
    except Exception as error:  # no network, no such repository, a name that is none
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise CorrmatError(f"hf:{repository} cannot be downloaded: {reason}") from error


def _load_safetensors(path: Path) -> nn.Module:
    """Load weights that ship, that `export_model` wrote, or that came from the Hub."""
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            about = file.metadata() or {}
        hparams = json.loads(about["network"])
        network = _network_type(about["method"])(**hparams)
    except (safetensors.SafetensorError, KeyError, ValueError, TypeError) as error:
        raise CorrmatError(f"{path} is no model of corrmat ({error!r})") from error
    return load_state(network, safetensors.torch.load_file(path))


def _network_type(method: str) -> type[nn.Module]:
    if method == "Invariant_corr":  # Lightning, which the others import, takes seconds
        return InvariantNetwork
    if method == "verification":
        return VerificationNetwork
    from corrmat.methods import METHODS

    return METHODS[method].network_type


def _shipped_file(model: str) -> Path:
    return SHIPPED.parent / f"{model}.safetensors"


def ship_network(
    model: str, method: str, hparams: Mapping[str, Any], network: nn.Module, **about: str
) -> Path:
    """Write a network's weights into the package.

    Args:
        model: its name for `load_model`.
        method: key of `METHODS`.
        hparams: of the network.
        network: trained.
        about: what else the header says.
    """
    path = _shipped_file(model)
    metadata = {"method": method, "network": json.dumps(dict(hparams)), **about}
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_bytes(path, _to_safetensors(network, metadata))
    return path


def _read_checkpoint(path: Path) -> Mapping[str, Any]:
    """Read a file with torch's loader for weights only."""
    if not path.is_file():
        raise CorrmatError(
            f"no model {str(path)!r}: neither corrmat, {', '.join(shipped_models())}, "
            "hf:name/model nor a file or folder of weights"
        )
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise CorrmatError(
            f"{path} is no checkpoint of tensors alone; nothing else is ever loaded"
        ) from error
    except Exception as error:  # unpickling a file of another kind raises errors of every type
        raise CorrmatError(f"{path} is no checkpoint, or cut short") from error
    if not isinstance(content, Mapping) or not content:
        raise CorrmatError(f"{path} holds no parameters by name")
    return content


def _tensors(path: Path, content: Mapping[str, Any]) -> State:
    """Find the named tensors in the content of a checkpoint."""
    for key in ("state_dict", "model", "model_state_dict"):
        if isinstance(content.get(key), Mapping):
            content = content[key]
    tensors = {str(k): v for k, v in content.items() if isinstance(v, Tensor)}
    if not tensors:
        raise CorrmatError(f"{path} holds no parameters by name")
    return {name.removeprefix("module."): value for name, value in tensors.items()}


def checkpoint_network(path: Path) -> tuple[str, dict[str, Any], nn.Module]:
    """Load the method's name, the network's hyper-parameters and the network of a checkpoint.

    Args:
        path: a checkpoint of `corrmat fit`, or of a Lightning Trainer and a method of ours.

    Raises:
        CorrmatError: the method is unknown, or the parameters do not fit.
    """
    return _network_of(path, _read_checkpoint(path))


def _network_of(path: Path, content: Mapping[str, Any]) -> tuple[str, dict[str, Any], nn.Module]:
    """Build the network of a checkpoint's content; see `checkpoint_network`."""
    from corrmat.methods import METHODS  # imports Lightning, which `register` does not need

    classes = {method.__name__: method for method in METHODS.values()}
    method = cast("str", content.get("method"))
    if method not in classes:
        if not method:
            raise CorrmatError(f"{path} is no checkpoint of corrmat fit: it names no method")
        raise CorrmatError(
            f"{path} is of method {method!r}, which is not corrmat's own ({', '.join(classes)}); "
            "run the same words through the file that defines it: python mine.py register ..."
        )
    try:
        hparams = content["hyper_parameters"]["network"]
        network = classes[method].network_type(**hparams)
    except (KeyError, TypeError, ValueError) as error:
        raise CorrmatError(f"{path} is of another version of corrmat ({error!r})") from error
    state = {
        name.removeprefix("network."): value
        for name, value in _tensors(path, content).items()
        if name.startswith("network.")
    }
    return method, hparams, load_state(network, state)
