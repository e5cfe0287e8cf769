"""Every block of code in README and docs works: Python is executed, commands are parsed."""

import inspect
import itertools
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from sybil import Sybil
from sybil.parsers.markdown import PythonCodeBlockParser

import corrmat
from corrmat.data.shapes import dataset
from corrmat.methods import METHODS, DCPCorr
from corrmat.networks.dcp import DCPNetwork
from corrmat.options import parse
from corrmat.weights import load_model

PAGES = ["README.md", *sorted(str(p.relative_to(ROOT)) for p in (ROOT / "docs").glob("*.md"))]
COMMAND = re.compile(r"^(?:\.venv/bin/)?(corrmat .*?|make .*?)(?:\s+#.*|\s*&&.*)?$")


@pytest.mark.parametrize(
    "page", [page for page in PAGES if "```python" in (ROOT / page).read_text()]
)
def test_python_blocks_are_executed(page, tmp_path, monkeypatch):
    document = Sybil(parsers=[PythonCodeBlockParser()]).parse(ROOT / page)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(dataset, "SIZE", {"train": 60, "test": 20})
    cloud = dataset.make_shape(("test", 0))[0][:300, :3]
    np.save("source.npy", cloud)
    np.save("target.npy", cloud[::-1] + 0.5)
    monkeypatch.setattr("corrmat.load_model", load_or_stand_in)
    monkeypatch.setitem(METHODS, "MineCorr", DCPCorr)  # a block names its own so: restored after
    for example in document.examples():
        example.evaluate()


def load_or_stand_in(model):
    """The authors' file is not committed: an untrained network stands for it."""
    return DCPNetwork() if model == "dcp_v1.t7" else load_model(model)


@pytest.mark.parametrize("page", PAGES)
def test_commands_are_understood(page, monkeypatch):
    """`corrmat` lines parse, `make` lines name a target and known variables."""
    makefile = (ROOT / "Makefile").read_text()
    text = (ROOT / page).read_text().replace("\\\n", " ")
    blocks = re.findall(r"^```sh\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    lines = [line.strip() for block in blocks for line in block.splitlines()]
    for line in lines:
        match = COMMAND.match(line)
        if not match:
            continue
        program, *words = shlex.split(match[1])
        if program == "corrmat":
            if "--help" not in words:
                parse(words)
            continue
        for word in words:
            name = word.split("=")[0]
            is_variable = "=" in word and re.search(rf"^{name} *[?:]?=", makefile, re.MULTILINE)
            assert is_variable or re.search(rf"(?<![\w.]){re.escape(word)}(?![\w])", makefile), line


def test_every_test_that_reliability_md_names_exists():
    text = (ROOT / "docs" / "reliability.md").read_text()
    code = "\n".join(path.read_text() for path in Path(ROOT / "tests").glob("test_*.py"))
    names = set(re.findall(r"::(test_\w+)", text))
    assert len(names) > 15
    assert not [name for name in names if f"def {name}(" not in code]


def test_the_table_of_public_names_is_complete_and_names_real_parameters():
    rows = re.findall(r"^\| (`.*?) \| (.*) \|$", (ROOT / "docs/api.md").read_text(), re.MULTILINE)
    cells = itertools.chain.from_iterable(rows)
    calls = [call for cell in cells for call in re.findall(r"`(\w+(?:\(.*?\))?)`", cell)]
    names = {call.partition("(")[0] for call in calls}
    assert set(corrmat.__all__) <= names
    for call in calls:
        name, _, parameters = call.rstrip(")").partition("(")
        assert name in corrmat.__all__
        known = {"*", *inspect.signature(getattr(corrmat, name)).parameters} if parameters else ()
        assert set(filter(None, parameters.split(", "))) <= set(known)
