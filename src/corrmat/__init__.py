"""Correspondence Matrices are Underrated (3DV 2020), reproduced.

Names are resolved on first use, so that `import corrmat` (and every worker process that
makes shapes) does not wait for torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from corrmat import methods, metrics
    from corrmat.data.datamodule import RegistrationDataModule
    from corrmat.errors import CorrmatError
    from corrmat.registration import Registration, register
    from corrmat.types import PairBatch, Prediction
    from corrmat.weights import load_model, load_reference

__version__ = "0.1.0"
__all__ = [
    "CorrmatError",
    "PairBatch",
    "Prediction",
    "Registration",
    "RegistrationDataModule",
    "load_model",
    "load_reference",
    "methods",
    "metrics",
    "register",
]

_HOME = {
    "CorrmatError": "corrmat.errors",
    "PairBatch": "corrmat.types",
    "Prediction": "corrmat.types",
    "RegistrationDataModule": "corrmat.data.datamodule",
    "Registration": "corrmat.registration",
    "load_model": "corrmat.weights",
    "load_reference": "corrmat.weights",
    "register": "corrmat.registration",
}


def __getattr__(name: str) -> object:
    if name in _HOME:
        return getattr(import_module(_HOME[name]), name)
    if name in __all__:
        return import_module(f"corrmat.{name}")
    raise AttributeError(f"module 'corrmat' has no attribute {name!r}")
