"""Rows of a matrix that never exists, against the matrix."""

import os
import subprocess
import sys

import pytest
import torch

from corrmat.ops import streaming
from corrmat.ops.streaming import argmax_rows, log_sums, softmax_rows


def vectors(generator, outlier):
    a, b, v = (
        torch.randn(2, n, d, generator=generator, dtype=torch.float64)
        for n, d in ((7, 4), (9, 4), (9, 3))
    )
    last = torch.randn(2, 7, generator=generator, dtype=torch.float64) if outlier else None
    return a.requires_grad_(), b.requires_grad_(), v, last


def dense(a, b, values, last):
    scores = a @ b.mT
    if last is not None:
        scores = torch.cat([scores, last.unsqueeze(-1)], -1)
    return scores.logsumexp(2), scores.softmax(2)[..., : b.shape[1]] @ values


@pytest.mark.parametrize("outlier", [False, True])
@pytest.mark.parametrize("size", [1, 40, 2**20])
def test_slices_equal_the_matrix_in_value_and_gradient(size, outlier, generator, monkeypatch):
    monkeypatch.setattr(streaming, "_DENSE", 0)
    monkeypatch.setattr(streaming, "_SLICE", size)
    a, b, v, last = vectors(generator, outlier)
    inputs = [a, b] if last is None else [a, b, last.requires_grad_()]
    pull = torch.randn(2, 7, 4, generator=generator, dtype=torch.float64)
    results = []
    for way in (softmax_rows, dense):
        total, mean = way(a, b, v, last)
        value = (torch.cat([total.unsqueeze(-1), mean], -1) * pull).sum()
        results.append([total, mean, *torch.autograd.grad(value, inputs)])
    for fast, naive in zip(*results, strict=True):
        torch.testing.assert_close(fast, naive)
    scores = a @ b.mT if last is None else torch.cat([a @ b.mT, last.unsqueeze(-1)], -1)
    assert (argmax_rows(a, b, last) == scores.argmax(2)).all()


@pytest.mark.parametrize("outlier", [False, True])
def test_gradient_is_the_derivative(outlier, generator, monkeypatch):
    monkeypatch.setattr(streaming, "_DENSE", 0)
    a, b, v, last = vectors(generator, outlier)
    inputs = (a, b) if last is None else (a, b, last.requires_grad_())
    assert torch.autograd.gradcheck(lambda a, b, last=None: softmax_rows(a, b, v, last), inputs)


@pytest.mark.parametrize("whole", [0, 2**22])
def test_scores_far_apart_neither_overflow_nor_lose_the_sum(whole, monkeypatch):
    monkeypatch.setattr(streaming, "_DENSE", whole)
    a, b = torch.tensor([[[1e4], [-1e4]]]), torch.tensor([[[1.0], [-1.0]]])
    total, mean = softmax_rows(a, b, b)
    assert total.tolist() == [[1e4, 1e4]]
    assert mean.flatten().tolist() == [1, -1]


MEMORY = """
import torch
from corrmat.losses import correspondence_loss
from corrmat.ops.correspondence import SoftCorrespondence
n, d = 8192, 64
f_x, f_y = (torch.randn(1, n, d).requires_grad_() for _ in range(2))
warm = SoftCorrespondence(f_x[:, :64], f_y[:, :64]).nll(torch.arange(64)[None])
warm.sum().backward()
def peak():  # ru_maxrss begins with the parent's, even in a fresh process
    status = open("/proc/self/status").read()
    return int(status.split("VmHWM:")[1].split()[0])
open("/proc/self/clear_refs", "w").write("5")  # from here on
before = peak()
c = SoftCorrespondence(f_x, f_y, d**-0.5)
match = torch.arange(n)[None]
(correspondence_loss(c, match) + c.soft_target(f_y[..., :3]).sum()).backward()
c.argmax()
print((peak() - before) / 1024)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_memory_is_not_that_of_the_matrix():
    """8192 x 8192 floats are 256 MB, and the dense way holds several of them at once.

    Every large block is mapped by itself, so that freed blocks that glibc keeps do not count:
    with them the same program takes 100 to 225 MB, by chance.
    """
    environment = os.environ | {"MALLOC_MMAP_THRESHOLD_": "65536"}
    result = subprocess.run(
        [sys.executable, "-c", MEMORY], capture_output=True, text=True, env=environment
    )
    assert 0 < float(result.stdout) < 60, result.stderr


@pytest.mark.parametrize("dense", [0, 2**23])
def test_log_sums_of_rows_and_columns(dense, generator, monkeypatch):
    monkeypatch.setattr(streaming, "_DENSE", dense)
    a, b = (torch.randn(2, n, 5, generator=generator, dtype=torch.float64) for n in (7, 9))
    scores = a @ b.mT
    rows, columns = log_sums(a, b)
    torch.testing.assert_close(rows, scores.logsumexp(2))
    torch.testing.assert_close(columns, scores.logsumexp(1))
