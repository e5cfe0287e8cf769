import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from jsonargparse import ArgumentParser

from corrmat.training import console, recipe

ROOT = Path(__file__).resolve().parents[1]
SHARED = Path(os.environ.get("CORRMAT_SHARED", ROOT.parent / "shared"))

# Tensors here are tiny, and a second thread only waits; so it does in the processes of tests.
torch.set_num_threads(1)
os.environ["OMP_NUM_THREADS"] = "1"
os.environ["WANDB_MODE"] = "disabled"
os.environ["no_proxy"] = "127.0.0.1,localhost"  # the tests' own servers


def shared(*parts: str) -> Path:
    """A file outside the project that a test compares with; the test is skipped without it."""
    path = SHARED.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"{path.name} is not at hand")
    return path


def golden(name: str) -> tuple[dict[str, torch.Tensor], dict]:
    """Arrays of a reference implementation and their hyper-parameters."""
    arrays = np.load(shared("golden", f"{name}.npz"))
    description = SHARED / "golden" / f"{name}.json"
    hparams = json.loads(description.read_text()) if description.exists() else {}
    return {key: torch.from_numpy(np.asarray(arrays[key])) for key in arrays}, hparams


def state_of(arrays: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {k.removeprefix("state/"): v for k, v in arrays.items() if k.startswith("state/")}


@pytest.fixture(autouse=True, scope="session")
def _no_cache_of_the_user(tmp_path_factory):
    """Fixtures of a module come before those of a test."""
    os.environ["CORRMAT_CACHE"] = str(tmp_path_factory.mktemp("cache"))


@pytest.fixture(autouse=True)
def _quiet_and_offline(monkeypatch, tmp_path):
    monkeypatch.setenv("CORRMAT_CACHE", str(tmp_path / "cache"))
    console.print_messages(0)
    yield
    torch.set_flush_denormal(False)  # a command sets it for good


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


def parse_overrides(words: list[str]) -> dict:
    """Settings like ["--data.keep", "0.7"] as nested overrides for `recipe.load`."""
    parser = ArgumentParser(exit_on_error=False)
    recipe.add_settings(parser)
    return parser.parse_args(words, defaults=False).as_dict()


def random_rotation(batch: int, generator: torch.Generator) -> torch.Tensor:
    q, r = torch.linalg.qr(torch.randn(batch, 3, 3, generator=generator, dtype=torch.float64))
    q = q * r.diagonal(dim1=1, dim2=2).sign().unsqueeze(1)
    return q * torch.det(q).view(-1, 1, 1)
