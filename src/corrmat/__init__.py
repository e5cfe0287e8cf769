"""Correspondence Matrices are Underrated (3DV 2020), reproduced.

Names are imported on first use, so that `import corrmat` does not wait for torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from corrmat import losses, methods, metrics
    from corrmat.data.datamodule import RegistrationDataModule
    from corrmat.data.pairs import PairSettings, make_pairs
    from corrmat.data.scans import read_scan
    from corrmat.errors import CorrmatError
    from corrmat.ops.correspondence import SoftCorrespondence
    from corrmat.reference import load_reference
    from corrmat.registration.pose_graph import ScanPose, register_scans
    from corrmat.registration.register import register
    from corrmat.registration.result import Registration
    from corrmat.types import PairBatch, Prediction
    from corrmat.weights import export_model, load_model, shipped_models

__version__ = "0.1.0"
__all__ = [
    "CorrmatError",
    "PairBatch",
    "PairSettings",
    "Prediction",
    "Registration",
    "RegistrationDataModule",
    "ScanPose",
    "SoftCorrespondence",
    "export_model",
    "load_model",
    "load_reference",
    "losses",
    "make_pairs",
    "methods",
    "metrics",
    "read_scan",
    "register",
    "register_scans",
    "shipped_models",
]

_MODULES = {
    "CorrmatError": "corrmat.errors",
    "PairBatch": "corrmat.types",
    "PairSettings": "corrmat.data.pairs",
    "Prediction": "corrmat.types",
    "RegistrationDataModule": "corrmat.data.datamodule",
    "Registration": "corrmat.registration.result",
    "ScanPose": "corrmat.registration.pose_graph",
    "SoftCorrespondence": "corrmat.ops.correspondence",
    "export_model": "corrmat.weights",
    "load_model": "corrmat.weights",
    "load_reference": "corrmat.reference",
    "make_pairs": "corrmat.data.pairs",
    "read_scan": "corrmat.data.scans",
    "register": "corrmat.registration.register",
    "register_scans": "corrmat.registration.pose_graph",
    "shipped_models": "corrmat.weights",
}


def __dir__() -> list[str]:
    """List the public names, also those not yet imported."""
    return sorted(__all__)


def __getattr__(name: str) -> object:
    """Import a public name on first use."""
    if name in _MODULES:
        return getattr(import_module(_MODULES[name]), name)
    if name in __all__:
        return import_module(f"corrmat.{name}")
    raise AttributeError(f"module 'corrmat' has no attribute {name!r}")
