"""Correspondence Matrices are Underrated (3DV 2020), reproduced.

Names are imported on first use, so that `import corrmat` does not wait for torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from corrmat import methods, metrics
    from corrmat.data.datamodule import RegistrationDataModule
    from corrmat.data.pairs import PairSettings
    from corrmat.errors import CorrmatError
    from corrmat.registration.register import Registration, register
    from corrmat.types import PairBatch, Prediction
    from corrmat.weights import load_model, load_reference

__version__ = "0.1.0"
__all__ = [
    "CorrmatError",
    "PairBatch",
    "PairSettings",
    "Prediction",
    "Registration",
    "RegistrationDataModule",
    "load_model",
    "load_reference",
    "methods",
    "metrics",
    "register",
]

_MODULES = {
    "CorrmatError": "corrmat.errors",
    "PairBatch": "corrmat.types",
    "PairSettings": "corrmat.data.pairs",
    "Prediction": "corrmat.types",
    "RegistrationDataModule": "corrmat.data.datamodule",
    "Registration": "corrmat.registration.register",
    "load_model": "corrmat.weights",
    "load_reference": "corrmat.weights",
    "register": "corrmat.registration.register",
}


def __getattr__(name: str) -> object:
    """Import a public name on first use."""
    if name in _MODULES:
        return getattr(import_module(_MODULES[name]), name)
    if name in __all__:
        return import_module(f"corrmat.{name}")
    raise AttributeError(f"module 'corrmat' has no attribute {name!r}")
