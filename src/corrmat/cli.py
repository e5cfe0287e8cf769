"""The command line; options.py parses it."""

import contextlib
import os
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from jsonargparse import Namespace

from corrmat.errors import CorrmatError, cannot_write
from corrmat.options import EXPERIMENT_COMMANDS, SHORT_HELP, build_parser, parse

if TYPE_CHECKING:
    import numpy as np

    from corrmat.registration.preparation import Cloud
    from corrmat.training.recipe import Recipe

_STDOUT = Path("-")  # as a file to write


def main(words: Sequence[str] | None = None) -> int:
    """Run a command; errors in the input are one line, without a traceback."""
    words = sys.argv[1:] if words is None else list(words)
    return exit_code(lambda: _run_command(words))


def exit_code(run: Callable[[], int]) -> int:
    """Call a function; turn what went wrong into a line and an exit code."""
    try:
        code = run()
        if sys.stdout:  # None if it is closed
            sys.stdout.flush()  # here a closed pipe can be dealt with
        return code
    except CorrmatError as error:
        print(f"corrmat: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("corrmat: interrupted", file=sys.stderr)
        return 1
    except BrokenPipeError:  # the reader of our output has closed it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        if not cannot_write(error):
            raise
        print(f"corrmat: error: {error}", file=sys.stderr)
        return 2


def _run_command(words: Sequence[str]) -> int:
    if not words:
        print(SHORT_HELP)
        return 0
    options = parse(words)
    return _COMMANDS[options.command](options)


def _run(options: Namespace) -> int:
    """Run an experiment."""
    config = _required_config(options)
    from corrmat.training import experiment, recipe

    prepare_output(options)
    loaded = recipe.load(config, options.scale, options.overrides)
    experiment.run(loaded, options.results, options.runs, options.logger, fresh=options.fresh)
    return 0


def fit_arm(options: Namespace) -> int:
    """Train one arm."""
    loaded = _load_arm(options)
    from corrmat.files import ensure_writable
    from corrmat.training import console, experiment, hardware, preflight

    arm = preflight.prepare(loaded.arms[loaded.treatment])
    ensure_writable(options.runs / loaded.place / arm.name)
    with console.Board() as board:
        trained = experiment.train_or_reuse(
            loaded, arm, options.runs, options.logger, board, fresh=options.fresh
        )
    if hardware.is_first_process():
        print(f"best checkpoint: {trained.checkpoint}")
    return 0


def _evaluate(options: Namespace) -> int:
    """Test the checkpoint of one arm."""
    loaded = _load_arm(options)
    from corrmat.training import experiment, fit, preflight, runs
    from corrmat.weights import load_model

    name = loaded.treatment
    folders = runs.arm_folders(loaded, name, options.runs)
    if options.checkpoint is None and not any((f / "best.ckpt").is_file() for f in folders):
        others = options.runs.glob(f"*/{loaded.data}/{loaded.place.name}/{name}/best.ckpt")
        scales = ", ".join(sorted(path.relative_to(options.runs).parts[0] for path in others))
        hint = f"there is one of --scale {scales}" if scales else "train first (corrmat fit)"
        raise CorrmatError(f"no checkpoint {folders[0] / 'best.ckpt'}; {hint}")
    given = options.checkpoint
    network = None
    if given is not None and given.suffix != ".ckpt":
        if "network" in options.overrides:
            raise CorrmatError(f"{given} has options of its network: --network.* changes none")
        network = load_model(given)
    elif given is not None and not given.is_file():
        raise CorrmatError(f"no checkpoint {given}; train first (corrmat fit)")
    arm = preflight.prepare(loaded.arms[name])
    checkpoint = given or runs.best_checkpoint(loaded, arm, options.runs)
    if network is None:
        method = fit.load_trained(arm, checkpoint)
    else:
        method = preflight.build_method(arm.settings)
        kinds = [type(each).__name__ for each in (network, method.network)]
        if kinds[0] != kinds[1]:
            raise CorrmatError(f"{given} does not fit: a {kinds[0]}, where {name} has a {kinds[1]}")
        method.network = network
    print(f"checkpoint: {checkpoint}")
    _, result = experiment.evaluate(method, arm, loaded)
    titles = [f"{low:g} to {high:g} deg" for low, high in pairwise(loaded.bands_deg)]
    titles += [f"{share:.0%} outliers" for share in loaded.sweep_outliers]
    if not result.bands:
        _print_metrics(result.metrics)
    for title, part in zip(titles, [*result.bands, *result.sweep], strict=True):
        print(f"\n{title}")
        _print_metrics(part.metrics)
    return 0


def _load_arm(options: Namespace) -> "Recipe":
    """Load the recipe with one arm: --arm, or its METHOD_corr."""
    config = _required_config(options)
    from corrmat.training import recipe

    prepare_output(options)
    arms = [options.arm] if options.arm else None
    return recipe.load(config, options.scale, options.overrides, arms)


def _print_metrics(metrics: Mapping[str, float]) -> None:
    for name, value in metrics.items():
        print(f"{name:28s} {value:.6g}")


def _required_config(options: Namespace) -> Path:
    if options.config is None:
        raise CorrmatError("which experiment? --config configs/exp/1.1.yaml")
    return options.config


def prepare_output(options: Namespace) -> None:
    """Choose what is printed while an experiment runs, and how the CPU computes."""
    from corrmat.training import console, fit, hardware

    fit.silence_libraries()
    hardware.flush_denormals()
    verbosity = int(options.get("verbose", False)) - int(options.get("quiet", False))
    console.print_messages(verbosity if hardware.is_first_process() else -1)


def _compare(options: Namespace) -> int:
    """Compare models on the frozen pairs of a protocol."""
    from corrmat.files import ensure_writable
    from corrmat.registration import benchmark
    from corrmat.registration.register import hypothesis_generator
    from corrmat.reporting.model_results import write_comparison
    from corrmat.revision import commit

    models = [name.strip() for name in options.models.split(",") if name.strip()]
    if not models:
        raise CorrmatError("which models? e.g. corrmat compare corrmat,icp")
    if options.record is not None:
        _refuse_folder(options.record)
        ensure_writable(options.record.parent)
    about = {name: options[name] for name in ("protocol", "data", "points")}
    if options.points is None:
        about["points"] = benchmark.TABLE_POINTS.get(options.protocol, (512,))[0]
    if options.protocol in benchmark.SCANS:
        if options.data != "shapes" or options.root:
            raise CorrmatError(
                f"{options.protocol} pairs are procedural: "
                "--data and --root go with other protocols"
            )
        about["data"] = "procedural"
    code = commit() if options.record is not None else None
    for model in models:
        hypothesis_generator(model)  # an unknown one is said before shapes are made
    pairs = benchmark.frozen_pairs(**about, root=options.root, count=options.pairs)
    results = benchmark.compare(pairs, models)
    fewer = f", one of each shape: {options.pairs} were asked for"
    print(f"{len(pairs)} pairs{fewer if len(pairs) < options.pairs else ''}")
    print(benchmark.to_table(results))
    if options.record is not None:
        write_comparison(options.record, results, about | {"pairs": len(pairs), "commit": code})
        print(f"record: {options.record}")
    return 0


def _register(options: Namespace) -> int:
    """Register one file, or several, onto another."""
    from corrmat.files import ensure_writable

    if options.init is not None:
        if len(options.source) > 1:
            raise CorrmatError("--init is a guess for one source; there are several")
        if not options.init.is_file():
            raise CorrmatError(f"{options.init}: no such file")

    json_file = None if options.json == _STDOUT else options.json
    files = [*filter(None, (json_file, options.html, options.gif)), *_moved_files(options)]
    written = [path.resolve() for path in files]
    for path, what, suffixes in (
        (options.gif, "the animation is a GIF", (".gif", "")),
        (options.html, "the page is HTML", (".html", ".htm", "")),
    ):
        if path is not None and (path == _STDOUT or path.suffix.lower() not in suffixes):
            has = "- is standard output" if path == _STDOUT else f"{path} has another suffix"
            raise CorrmatError(f"{what}, {has}")
    for path in files:
        if written.count(path.resolve()) > 1:
            raise CorrmatError(f"{path} is named for two results, and one would be lost")
        _refuse_folder(path)
        if not path.parent.is_dir() and path.parent != options.output:
            raise CorrmatError(f"no folder {path.parent} to write {path.name} into")
        for scan in (*options.source, options.target):
            if scan.resolve() == path.resolve():
                raise CorrmatError(f"{path} is one of the scans, and would be overwritten")
        if path.is_file() or not path.exists():  # not a pipe
            ensure_writable(path.parent)
    with contextlib.redirect_stdout(sys.stderr if options.json == _STDOUT else sys.stdout):
        content = (_register_several if len(options.source) > 1 else _register_pair)(options)
    if options.json == _STDOUT:
        print(content, end="")
    return 0


def _moved_files(options: Namespace) -> list[Path]:
    """List the PLY files of the moved scans: --output, or one for each scan in that folder.

    Raises:
        CorrmatError: --output does not go with the scans.
    """
    output, scans = options.output, options.source
    if output is None:
        return []
    is_ply = output.suffix.lower() == ".ply"
    if len(scans) == 1:
        if not is_ply:
            raise CorrmatError(f"the moved source is written as PLY, {output} has another suffix")
        return [output]
    if is_ply or output.is_file():
        raise CorrmatError(f"{output}: with several scans, --output is a folder")
    names = [path.with_suffix(".ply").name for path in scans]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        both = [str(scan) for scan, name in zip(scans, names, strict=True) if name == twice]
        raise CorrmatError(f"{' and '.join(both)} would both become {output / twice}: rename one")
    return [output / name for name in names]


def _refuse_folder(path: Path) -> None:
    """Refuse a folder where a file is to be written."""
    if path.is_dir():
        raise CorrmatError(f"{path} is a folder, not a file to write")


def _register_pair(options: Namespace) -> str:
    """Register one file onto another; return the result as JSON."""
    from corrmat.data.scans import write_moved
    from corrmat.files import replace_bytes, replace_text

    names = str(options.source[0]), str(options.target)
    (source, target), clouds = _read_scans(options)
    from corrmat.registration.register import register
    from corrmat.registration.result import read_transform, to_json, to_text

    registration = register(
        *clouds, model=options.model, refine=options.refine, seed=options.seed,
        init=None if options.init is None else read_transform(options.init),
    )  # fmt: skip
    print(to_text(registration))
    if options.output is not None:
        kept = write_moved(options.output, options.source[0], registration.transform)
        print(f"moved source: {options.output} ({kept})")
    content = to_json(registration, *names)
    _write_json(options.json, content)
    if options.html is not None:
        from corrmat.registration.view import registration_page  # plotly takes a second to import

        replace_text(options.html, registration_page(registration, source, target, names))
        print(f"page: {options.html}")
    if options.gif is not None:
        from corrmat.registration.animation import registration_gif  # matplotlib too

        replace_bytes(options.gif, registration_gif(registration, source, target))
        print(f"animation: {options.gif}")
    return content


def _read_scans(options: Namespace) -> "tuple[list[np.ndarray], list[Cloud]]":
    """Read the points of all scans and prepare their clouds; errors name the file."""
    from corrmat.data.scans import read_scan

    paths = *options.source, options.target
    scans = [read_scan(path, options.seed) for path in paths]
    from corrmat.registration.preparation import Cloud  # slow, and not needed to refuse a file

    named = zip(scans, map(str, paths), strict=True)
    return scans, [Cloud.of(scan, name, options.seed) for scan, name in named]


def _write_json(path: Path | None, content: str) -> None:
    """Write a result to the file that --json names; standard output comes last."""
    from corrmat.files import replace_text

    if path is not None and path != _STDOUT:
        replace_text(path, content)
        print(f"result: {path}")


def _register_several(options: Namespace) -> str:
    """Register several files onto one; return the result as JSON."""
    if options.html or options.gif:
        raise CorrmatError("--html and --gif show two scans; --output moves several, to look at")
    from corrmat.data.scans import write_moved

    _, clouds = _read_scans(options)
    from corrmat.registration import pose_graph

    poses = pose_graph.register_scans(
        clouds, model=options.model, refine=options.refine, seed=options.seed
    )
    print(pose_graph.to_text(options.source, options.target, poses))
    if options.output is not None:
        options.output.mkdir(parents=True, exist_ok=True)
        for path, scan, pose in zip(_moved_files(options), options.source, poses, strict=True):
            write_moved(path, scan, pose.transform)
        print(f"moved scans: {options.output}")
    content = pose_graph.to_json(
        options.source, options.target, poses, model=options.model, seed=options.seed
    )
    _write_json(options.json, content)
    return content


def _export(options: Namespace) -> int:
    """Write shipped weights as a folder."""
    from corrmat.weights import export_model

    export_model(options.model, options.folder)
    print(f"{options.folder}: model.safetensors, config.json and README.md of {options.model}")
    return 0


def _example(options: Namespace) -> int:
    """Write two scans to try."""
    from corrmat.registration.example import write_example

    folder = options.folder
    write_example(folder)
    names = (str(folder / name) for name in ("source.ply", "target.ply", "view.html"))
    source, target, page = map(shlex.quote, names)
    print(
        f"{folder}: source.ply, target.ply and truth.json, two scans of one shape. Now try\n"
        f"  corrmat register {source} {target} --html {page}"
    )
    return 0


def _data(options: Namespace) -> int:
    """Make or fetch a data set."""
    if options.name == "shapes" and (options.root or options.mirror):
        raise CorrmatError("--root and --mirror go with modelnet40: corrmat data modelnet40 ...")
    sheet = options.sheet
    if sheet is not None and (options.name != "shapes" or not sheet.parent.is_dir()):
        raise CorrmatError(f"--sheet {sheet}: draws the embedded shapes, into an existing folder")
    if options.name == "modelnet40":
        from corrmat.data import modelnet40
        from corrmat.training.console import print_messages

        if options.root is None:
            raise CorrmatError("where to? --root folder")
        print_messages(0)
        folder = modelnet40.fetch(options.root, options.mirror or (modelnet40.SOURCE,))
        print(f"{folder}: complete; use it with DATA=modelnet40 ROOT={options.root}")
        return 0
    from corrmat.data.clouds import cache_folder
    from corrmat.data.shapes import dataset

    for split in dataset.SIZE:
        clouds = dataset.load(split)
        print(f"{split}: {len(clouds)} shapes of {len(clouds.names)} families in {cache_folder()}")
    if sheet is not None:
        from corrmat.reporting.contact_sheet import draw_contact_sheet

        draw_contact_sheet(dataset.load("train"), sheet)
        print(f"drawn: {sheet}")
    return 0


def _robustness(options: Namespace) -> int:
    """Compute figure 2."""
    from corrmat.files import ensure_writable
    from corrmat.reporting import robustness

    smoke = options.scale == "smoke"
    folder = options.results / ("smoke" if smoke else "laptop") / "robustness"
    ensure_writable(folder)
    draws = 20 if smoke else 400
    result = robustness.run(folder, draws=draws, seed=options.seed)
    print("mean rotation error, deg, by per cent corrupted:\n")
    print(robustness.terminal_table(result))
    print(f"\nrecord: {folder}")
    return 0


def _report(options: Namespace) -> int:
    """Write the page of all records, or the documents' tables."""
    from corrmat.files import replace_text
    from corrmat.reporting.record import read_records

    results, output, docs = options.results, options.output, options.docs
    if output is None and docs is None:
        raise CorrmatError("what to write? -o report.html, or --docs . for the documents' tables")
    if not read_records(results):
        raise CorrmatError(f"no records in {results}; run an experiment first")
    if output is not None:
        _refuse_folder(output)
        if not output.parent.is_dir():
            raise CorrmatError(f"no folder {output.parent} to write into")
        from corrmat.reporting.page import build_page

        content = build_page(results)
        replace_text(output, content)
        print(f"{output}: {len(content) / 1e6:.1f} MB, open it in a browser")
    if docs is not None:
        from corrmat.reporting.documents import rewrite_documents

        print(f"{rewrite_documents(results, docs)} records -> README.md and docs/ in {docs}")
    return 0


def _completion(options: Namespace) -> int:
    """Print a completion script."""
    import shtab

    print(shtab.complete(build_parser(EXPERIMENT_COMMANDS), options.shell))
    return 0


_COMMANDS: dict[str, Callable[[Namespace], int]] = {
    "run": _run,
    "fit": fit_arm,
    "evaluate": _evaluate,
    "compare": _compare,
    "register": _register,
    "export": _export,
    "example": _example,
    "data": _data,
    "robustness": _robustness,
    "report": _report,
    "completion": _completion,
}
