"""Where a record comes from: its command, and what of the code has changed since its commit."""

import ast
import functools
from collections.abc import Iterable
from pathlib import Path

import yaml

from corrmat.data.registry import DATASETS, is_generated
from corrmat.methods import METHODS
from corrmat.reporting.record import COMMIT_SEPARATOR, Record
from corrmat.revision import PACKAGE, git

# The modules that compute an arm's numbers; what they import belongs to it, up to the boundary.
_ROOTS = ("corrmat.training.fit", "corrmat.training.recipe")
_BOUNDARY = ("corrmat.reporting", "corrmat.training.console", "corrmat.training.loggers")
_NETWORKS = "corrmat.networks"
_NOT_TRAINING = ("title", "paper", "baselines", "test_pairs", "scales")  # keys of a recipe


def command(record: Record) -> str:
    """Return the command that makes a record again; a recipe of one's own has no make target."""
    if not record.paper:
        return f"corrmat run --config ... --scale {record.scale}"
    target = record.id if record.id == "outliers" else f"exp{record.id}"
    scale = "" if record.scale == "laptop" else f" SCALE={record.scale}"
    if record.data == "shapes":
        data = ""
    elif is_generated(record.data):
        data = f" DATA={record.data}"
    elif record.data in DATASETS:
        data = f" DATA={record.data} ROOT=..."
    else:  # named after the folder, or by NAME
        data = f" DATA=folder ROOT=... NAME={record.data}"
    seed = "" if record.seed == 0 else f' ARGS="--seed {record.seed}"'
    return f"make {target}{scale}{data}{seed}"


def staleness(record: Record, repository: Path) -> str:
    """Say what has changed since a record's arms were trained; empty if nothing has.

    Comments, docstrings and formatting do not count.

    Args:
        record: with the commits that its arms were trained at.
        repository: a checkout that has these commits.
    """
    trained = (str(arm.trained_at or record.commit) for arm in record.arms.values())
    commits = {commit for each in trained for commit in each.split(COMMIT_SEPARATOR)}
    if any(name == "None" or name.endswith("+") for name in commits):
        return "trained with uncommitted code"
    code = [f"src/{path}" for path in code_of(record.family, record.arms)]
    code += [f"configs/exp/{record.id}.yaml", f"configs/{record.family.lower()}.yaml"]
    changed: set[str] = set()
    for name in commits:
        try:
            diff = git(repository, "diff", "--name-only", "--relative", name, "--", *code)
        except OSError:
            return "git is missing: nobody can tell whether the code has changed"
        if diff.returncode:
            return f"commit {name} is missing: nobody can tell whether the code has changed"
        for path in diff.stdout.split():
            then, now = _text_at(repository, name, path), repository / path
            if then is None or not now.exists():
                changed.add(now.name)
                continue
            texts = then, now.read_text()
            if path.endswith(".yaml"):
                before, after = (_training_settings(text, record.scale) for text in texts)
            else:
                before, after = map(_code, texts)
            if before != after:
                changed.add(now.name)
    return f"changed since: {', '.join(sorted(changed))}" if changed else ""


def code_of(family: str, arms: Iterable[str]) -> list[str]:
    """List the files that a family's numbers depend on, from the import graph of the package.

    Other families' networks do not count.

    Args:
        family: of the record; the start of its methods' names.
        arms: names of arms, which may be methods.

    Returns:
        Paths like "corrmat/ops/rigid.py".
    """
    methods = [name for name in METHODS if name in arms or name.split("_")[0] == family]
    networks = {METHODS[name].network_type.__module__ for name in methods or METHODS}
    pending, reached = {*_ROOTS, *networks}, set[str]()
    if nowhere := [module for module in _ROOTS if _path(module) is None]:
        raise ModuleNotFoundError(f"{', '.join(nowhere)}: no such module")
    while pending:
        module = pending.pop()
        path = _path(module)
        if module in reached or path is None or module.startswith(_BOUNDARY):
            continue
        reached.add(module)
        for name in _imports(path):
            skip_networks = name.startswith(_NETWORKS) and not module.startswith(_NETWORKS)
            pending |= set() if skip_networks else {name}
    paths = (_path(module) for module in reached)
    return sorted(p.relative_to(PACKAGE.parent).as_posix() for p in paths if p is not None)


@functools.cache
def _imports(path: Path) -> frozenset[str]:
    """List the modules of the package that a file may import."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("corrmat"):
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names if alias.name.startswith("corrmat")}
    return frozenset(names)


def _path(module: str) -> Path | None:
    """Return the file of a module; None for a name that is not a module."""
    path = PACKAGE.parent.joinpath(*module.split(".")).with_suffix(".py")
    return path if path.is_file() else None


# Records share most of their code and commits: hence the caches.


@functools.cache
def _text_at(repository: Path, commit: str, path: str) -> str | None:
    """Return a file's content at a commit; None if it has no such file."""
    shown = git(repository, "show", f"{commit}:./{path}")
    return None if shown.returncode else shown.stdout


@functools.cache
def _training_settings(recipe: str, scale: str) -> object:
    """Parse a recipe, as far as it decides how arms train at a scale.

    Its baselines and expected numbers are left out.
    """
    content = yaml.safe_load(recipe)
    layer = (content.get("scales") or {}).get(scale)
    return {k: v for k, v in content.items() if k not in _NOT_TRAINING} | {"scales": layer}


@functools.cache
def _code(module: str) -> str:
    """Parse a module; comments, docstrings and formatting are left out."""
    tree = ast.parse(module)
    for node in ast.walk(tree):
        documented = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
        if documented and ast.get_docstring(node, clean=False) is not None:
            del node.body[0]
    return ast.dump(tree)
