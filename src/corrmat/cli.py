"""The command line. It parses, and calls one function of a wing for each command."""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

from jsonargparse import ArgumentParser, Namespace

from corrmat.errors import CorrmatError

EPILOG = """examples:
  corrmat register source.ply target.ply -o aligned.ply --html view.html
      align two clouds of your own (corrmat example DIR writes two to try)
  corrmat run --config configs/exp/1.1.yaml
      both arms at laptop scale, our numbers beside the paper's
  corrmat run --config configs/exp/1.2.yaml --scale smoke
      the same in seconds, to see that everything works
  corrmat fit --config configs/exp/1.1.yaml --arm DCP_corr --trainer.max_steps 200
      one arm, with any setting changed
  corrmat evaluate --config configs/exp/1.1.yaml --arm DCP_corr
      the best checkpoint of the last run (or --checkpoint FILE) on the frozen test pairs
  corrmat compare corrmat,ransac,fgr,icp --protocol real
      the shipped weights beside the classical pipelines, on the same frozen pairs
  corrmat robustness
      figure 2 of the paper: curve and picture in results/laptop/robustness
  corrmat data --sheet shapes.png
      make the embedded data set, draw its families

  eval "$(corrmat completion bash)"
      complete commands, options and files with the tab key (also zsh, tcsh)

Every setting of a recipe is an option, too: --data.*, --network.*, --loss.*, --optimizer.*,
--trainer.* (Lightning's own Trainer) and --seed. corrmat fit --help lists them with their types.

exit codes: 0 done; 1 interrupted (the same command continues from its checkpoint);
2 the input cannot be used, and one line says why."""

RUN_EPILOG = """examples:
  corrmat run --config configs/exp/1.2.yaml
  corrmat run --config configs/exp/1.2.yaml --scale smoke --logger none -q
  corrmat run --config configs/exp/1.1.yaml --data.data modelnet40 --data.root /data
  corrmat run --config configs/exp/1.1.yaml --data.data folder --data.root meshes"""

FIT_EPILOG = """examples:
  corrmat fit --config configs/exp/1.1.yaml
  corrmat fit --config configs/exp/2.2.yaml --arm RPMNet --trainer.max_steps 500
  corrmat fit --config configs/exp/outliers.yaml --arm DCP_corr --network.outlier dustbin
Ctrl-C saves a checkpoint; the same command continues from it."""

EVALUATE_EPILOG = """examples:
  corrmat evaluate --config configs/exp/1.1.yaml
  corrmat evaluate --config configs/exp/1.1.yaml --checkpoint best.ckpt --data.rotation_deg 45"""

COMPARE_EPILOG = """examples:
  corrmat compare corrmat,ransac,fgr,icp --protocol real
  corrmat compare corrmat,dcp_v1.t7 --data modelnet40 --root /data --points 1024

protocols: real: disjoint samples, noise, both clouds cropped and with outliers, normals
estimated; clean: the same without crop and outliers; paper: experiment 1.2's pairs."""

REGISTER_EPILOG = """examples:
  corrmat register scan1.ply scan2.ply
      print the 4 x 4 matrix that takes scan1 onto scan2, and how far to trust it
  corrmat register part.stl scan.pcd -o aligned.ply --json T.json --html view.html
      write the moved source, the result for programs, and a page to look at
  corrmat register a.npy b.npy --model ransac
      the classical pipeline instead (pip install open3d)

Files: PLY, OBJ, STL, OFF, GLB, GLTF (meshes are sampled, scenes merged), PCD, XYZ, TXT, CSV,
NPY, NPZ. Both files must have the same unit, whichever it is. Parts may be missing from either.

exit codes: 0 done, whatever the verdict; 2 a file cannot be used, and one line says why."""

Scale = Literal["smoke", "laptop", "paper"]
EXPERIMENT_COMMANDS = ("run", "fit", "evaluate")


def main(words: Sequence[str] | None = None) -> int:
    """Run a command; errors in the input are one line, without a traceback."""
    words = sys.argv[1:] if words is None else list(words)
    try:
        return _run_command(words)
    except CorrmatError as error:
        print(f"corrmat: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("corrmat: interrupted; nothing was recorded", file=sys.stderr)
        return 1
    except BrokenPipeError:  # the reader of our output has closed it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:  # a full disk, a folder without permission
        print(f"corrmat: error: {error}", file=sys.stderr)
        return 2


def reproduce(experiment: str) -> None:
    """Run the experiment of this id with the caller's options: all that reproduce/*.py do."""
    sys.exit(main(["run", "--config", str(_config_folder() / f"{experiment}.yaml"), *sys.argv[1:]]))


def train_on_ray() -> None:
    """Train every arm of every experiment on a Ray cluster: reproduce/on_ray.py."""
    try:
        options = parse(["fit", *sys.argv[1:]])
        from corrmat.training import cluster

        _prepare_output(options)
        cluster.train_all(
            sorted(_config_folder().glob("*.yaml")), options.scale, options.overrides,
            options.runs, options.logger, fresh=options.fresh,
        )  # fmt: skip
    except CorrmatError as error:
        sys.exit(f"corrmat: error: {error}")


def train_weights(recipe: Path) -> None:
    """Train the weights that `corrmat register` ships: reproduce/weights.py.

    Only weights of the laptop scale, trained on the embedded shapes, are shipped.
    """
    words = ["fit", "--config", str(recipe), *sys.argv[1:]]
    code = main(words)
    if code == 0 and not {"-h", "--help"} & set(words):
        options = parse(words)
        from corrmat.registration.shipping import ship
        from corrmat.training.recipe import load

        experiment = load(recipe, options.scale, options.overrides)
        if (experiment.scale, experiment.data) == ("laptop", "shapes"):
            ship(options.runs / experiment.place / experiment.treatment / "last.ckpt")
    sys.exit(code)


def parse(words: Sequence[str]) -> Namespace:
    """Parse a command line.

    Returns:
        The command's options with the command's name as `command`. Settings of a recipe are not
        among them: those that were given are in `overrides`, nested.

    Raises:
        CorrmatError: an option is unknown or missing, or a value is not valid.
    """
    command = words[0] if words and words[0] in EXPERIMENT_COMMANDS else None
    parser = build_parser([command] if command else [])
    try:
        parsed = parser.parse_args(list(words))
        given = parser.parse_args(list(words), defaults=False) if command else Namespace()
    except argparse.ArgumentError as error:
        lines = [line.strip(" -") for line in str(error).splitlines() if line.strip(" -")]
        raise CorrmatError(f"{' '.join(lines[:2])}; see corrmat --help") from error
    options = parsed[parsed.command]
    options.command = parsed.command
    if command:
        from corrmat.training.recipe import GROUPS

        settings = given[parsed.command].as_dict()
        options.overrides = {k: v for k, v in settings.items() if k in ("seed", *GROUPS)}
    return options


def build_parser(with_settings: Sequence[str] = ()) -> ArgumentParser:
    """Build the parser of every command.

    Args:
        with_settings: commands that get the typed settings of recipes, whose import takes seconds.
    """
    raw = argparse.RawDescriptionHelpFormatter
    parser = ArgumentParser(
        prog="corrmat",
        description="Correspondence Matrices are Underrated (3DV 2020), reproduced.",
        epilog=EPILOG,
        formatter_class=raw,
        exit_on_error=False,
    )
    commands = parser.add_subcommands(dest="command", metavar="command")

    def add(name: str, purpose: str, epilog: str = "", usage: str | None = None) -> ArgumentParser:
        command = ArgumentParser(
            prog=f"corrmat {name}", description=purpose, epilog=epilog, formatter_class=raw,
            exit_on_error=False, usage=usage,
        )  # fmt: skip
        commands.add_subcommand(name, command, help=purpose)
        return command

    _add_experiment_options(
        add("run", "train and test every arm, write a record, print it beside the paper's",
            RUN_EPILOG, "corrmat run --config FILE [options]"), "run", with_settings,
    )  # fmt: skip
    _add_experiment_options(
        add("fit", "train one arm", FIT_EPILOG, "corrmat fit --config FILE [options]"),
        "fit", with_settings,
    )  # fmt: skip
    _add_experiment_options(
        add("evaluate", "test the checkpoint of one arm", EVALUATE_EPILOG,
            "corrmat evaluate --config FILE [options]"), "evaluate", with_settings,
    )  # fmt: skip
    _add_compare_options(add("compare", "compare models on the same frozen pairs", COMPARE_EPILOG))
    _add_register_options(add("register", "align two clouds of your own", REGISTER_EPILOG))
    example = add("example", "write two scans to try register on")
    example.add_argument("folder", type=Path, help="for source.ply, target.ply and truth.json")
    robustness = add("robustness", "figure 2: wrong matches against a wrong rotation vector")
    robustness.add_argument(
        "--scale", type=Scale, default="laptop",
        help="smoke: 20 draws a point of a curve instead of 400",
    )  # fmt: skip
    robustness.add_argument("--results", type=Path, default=Path("results"), help="of records")
    robustness.add_argument("--seed", type=_count, default=0, help="of the draws")
    data = add(
        "data", "make the embedded data set, or fetch ModelNet40",
        "examples:\n  corrmat data --sheet a.png\n  corrmat data modelnet40 --root /data",
    )  # fmt: skip
    data.add_argument("name", nargs="?", type=Literal["shapes", "modelnet40"], default="shapes")
    data.add_argument("--root", type=Path, help="modelnet40: folder to fetch it into")
    data.add_argument(
        "--mirror", action="append", metavar="URL",
        help="modelnet40: address of its zip; may be given more than once",
    )  # fmt: skip
    data.add_argument("--sheet", type=Path, metavar="PNG", help="draw one shape of every family")
    report = add(
        "report", "one page, or the documents' tables, from results/",
        "examples:\n  corrmat report -o report.html\n  corrmat report results/ --docs .",
    )  # fmt: skip
    report.add_argument("results", nargs="?", type=Path, default=Path("results"), help="of records")
    report.add_argument("-o", "--output", type=Path, help="write all records as one HTML page")
    report.add_argument(
        "--docs", type=Path, help="folder of README.md and docs/: rewrite tables, redraw pictures"
    )
    completion = add("completion", "print a script that completes words in a shell")
    completion.add_argument("shell", type=Literal["bash", "zsh", "tcsh"])
    return parser


def _add_experiment_options(
    parser: ArgumentParser, name: str, with_settings: Sequence[str]
) -> None:
    """Add the options of run, fit and evaluate."""
    parser.add_argument("--config", type=Path, help="the experiment, e.g. configs/exp/1.1.yaml")
    parser.add_argument("--scale", type=Scale, default="laptop", help="of the experiment")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="of checkpoints and logs")
    if name in ("run", "fit"):
        parser.add_argument(
            "--logger", type=Literal["none", "csv", "wandb"], default="wandb",
            help="wandb: CSV and wandb offline; csv; none. The record is written in any case",
        )  # fmt: skip
        parser.add_argument(
            "--fresh", action="store_true",
            help="train anew, even where a run of the same settings was interrupted or is done",
        )  # fmt: skip
        parser.add_argument("-q", "--quiet", action="store_true", help="print results only")
        parser.add_argument(
            "-v", "--verbose", action="store_true", help="Lightning's messages, too"
        )
    if name == "run":
        parser.add_argument("--results", type=Path, default=Path("results"), help="of records")
    else:
        parser.add_argument("--arm", help="one of the recipe's arms (default: its METHOD_corr)")
    if name == "evaluate":
        parser.add_argument(
            "--checkpoint", type=Path, help="default: best.ckpt of the arm's last fit or run"
        )
    if name in with_settings:
        from corrmat.training.recipe import add_settings

        add_settings(parser)


def _add_compare_options(parser: ArgumentParser) -> None:
    """Add the options of compare."""
    parser.add_argument("models", help="e.g. corrmat,ransac,fgr,icp or checkpoint files")
    parser.add_argument(
        "--protocol", type=Literal["paper", "real", "clean"], default="real", help="see below"
    )
    parser.add_argument("--data", default="shapes", help="shapes, modelnet40 or folder")
    parser.add_argument("--root", type=Path, help="folder of the data set")
    parser.add_argument(
        "--points", type=_positive, default=512, help="points of a cloud before it is cropped"
    )
    parser.add_argument("--pairs", type=_positive, default=120, help="number of pairs")
    parser.add_argument(
        "--record", type=Path, metavar="JSON", help="write the table and the values of each pair"
    )


def _add_register_options(parser: ArgumentParser) -> None:
    """Add the options of register."""
    parser.add_argument("source", type=Path, help="the cloud or mesh that is moved")
    parser.add_argument("target", type=Path, help="the cloud or mesh that it is moved onto")
    parser.add_argument(
        "-o", "--output", type=Path, metavar="PLY",
        help="write the moved source (the points sampled on it, if it is a mesh)",
    )  # fmt: skip
    parser.add_argument("--json", type=Path, help="write matrix, confidence and verdict")
    parser.add_argument("--html", type=Path, help="write a page: before, matches, after")
    parser.add_argument(
        "--model", default="corrmat",
        help="corrmat (the shipped weights), icp, ransac, fgr, or a checkpoint file",
    )  # fmt: skip
    parser.add_argument(
        "--refine", type=Literal["icp", "none"], default="icp", help="refinement after the model"
    )
    parser.add_argument("--seed", type=_count, default=0, help="of subsampling and random draws")


def _count(text: str) -> int:
    """Parse a seed or a number of things."""
    value = int(text)
    if not 0 <= value < 2**32:
        raise argparse.ArgumentTypeError(f"{value} is not between 0 and 2^32")
    return value


def _positive(text: str) -> int:
    value = _count(text)
    if not value:
        raise argparse.ArgumentTypeError("must be at least 1")
    return value


def _run_command(words: Sequence[str]) -> int:
    if not words:
        raise CorrmatError("which command? see corrmat --help")
    options = parse(words)
    return _COMMANDS[options.command](options)


def _run(options: Namespace) -> int:
    """Run an experiment."""
    config = _required_config(options)
    from corrmat.training import experiment, recipe

    _prepare_output(options)
    loaded = recipe.load(config, options.scale, options.overrides)
    experiment.run(loaded, options.results, options.runs, options.logger, fresh=options.fresh)
    return 0


def _fit(options: Namespace) -> int:
    """Train one arm."""
    config = _required_config(options)
    from corrmat.files import ensure_writable
    from corrmat.training import console, experiment, preflight, recipe

    _prepare_output(options)
    arms = [options.arm] if options.arm else None
    loaded = recipe.load(config, options.scale, options.overrides, arms)
    arm = preflight.prepare(loaded.arms[loaded.treatment])
    ensure_writable(options.runs / loaded.place / arm.name)
    with console.Board() as board:
        trained = experiment.train_or_reuse(
            loaded, arm, options.runs, options.logger, board, fresh=options.fresh
        )
    print(f"best checkpoint: {trained.checkpoint}")
    return 0


def _evaluate(options: Namespace) -> int:
    """Test the checkpoint of one arm."""
    config = _required_config(options)
    from corrmat.metrics import summary
    from corrmat.training import experiment, fit, preflight, recipe, runs

    _prepare_output(options)
    arms = [options.arm] if options.arm else None
    loaded = recipe.load(config, options.scale, options.overrides, arms)
    arm = preflight.prepare(loaded.arms[loaded.treatment])
    checkpoint = options.checkpoint or runs.best_checkpoint(loaded, arm, options.runs)
    method = fit.load_trained(arm, checkpoint)
    print(f"checkpoint: {checkpoint}")
    tests = fit.score(method, arm, experiment.bands(loaded.bands_deg))
    for band, per_pair in enumerate(tests):
        if loaded.bands_deg:
            print(f"\n{loaded.bands_deg[band]:g} to {loaded.bands_deg[band + 1]:g} deg")
        for name, value in summary(per_pair).items():
            print(f"{name:28s} {value:.6g}")
    return 0


def _required_config(options: Namespace) -> Path:
    if options.config is None:
        raise CorrmatError("which experiment? --config configs/exp/1.1.yaml")
    return options.config


def _prepare_output(options: Namespace) -> None:
    """Choose what is printed while an experiment runs."""
    from corrmat.training import console, fit, hardware

    fit.silence_libraries()
    verbosity = int(options.get("verbose", False)) - int(options.get("quiet", False))
    console.print_messages(verbosity if hardware.is_first_process() else -1)


def _compare(options: Namespace) -> int:
    """Compare models on the frozen pairs of a protocol."""
    from corrmat.files import ensure_writable
    from corrmat.registration import benchmark

    if options.record is not None:
        ensure_writable(options.record.parent)
    about = {name: options[name] for name in ("protocol", "data", "points")}
    pairs = benchmark.frozen_pairs(**about, root=options.root, count=options.pairs)
    results = benchmark.compare(pairs, options.models.split(","))
    print(f"{len(pairs)} pairs")
    print(benchmark.to_table(results))
    if options.record is not None:
        benchmark.write_results(options.record, results, about | {"pairs": len(pairs)})
        print(f"record: {options.record}")
    return 0


def _register(options: Namespace) -> int:
    """Register two files."""
    for path in (options.output, options.json, options.html):
        if path is not None and not path.parent.is_dir():
            raise CorrmatError(f"no folder {path.parent} to write {path.name} into")
    if options.output is not None and options.output.suffix.lower() != ".ply":
        raise CorrmatError(
            f"the moved source is written as PLY, {options.output} has another suffix"
        )
    from corrmat.data.scans import read_scan, write_ply
    from corrmat.files import replace_text

    source, target = (read_scan(path, options.seed) for path in (options.source, options.target))
    from corrmat.registration.register import register, to_json, to_text

    registration = register(
        source, target, model=options.model, refine=options.refine, seed=options.seed
    )
    print(to_text(registration))
    if options.output is not None:
        rotation, translation = registration.transform[:3, :3], registration.transform[:3, 3]
        write_ply(options.output, source @ rotation.T + translation)
        print(f"moved source: {options.output}")
    if options.json is not None:
        replace_text(options.json, to_json(registration))
        print(f"result: {options.json}")
    if options.html is not None:
        from corrmat.registration.view import registration_page  # plotly takes a second to import

        replace_text(options.html, registration_page(registration, source, target))
        print(f"page: {options.html}")
    return 0


def _example(options: Namespace) -> int:
    """Write two scans to try."""
    from corrmat.registration.example import write_example

    folder = options.folder
    write_example(folder)
    print(
        f"{folder}: source.ply, target.ply and truth.json, two scans of one shape. Now try\n"
        f"  corrmat register {folder / 'source.ply'} {folder / 'target.ply'} "
        f"--html {folder / 'view.html'}"
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

    folder = options.results / options.scale / "robustness"
    ensure_writable(folder)
    draws = 20 if options.scale == "smoke" else 400
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
        from corrmat.reporting.page import build_page

        if not output.parent.is_dir():
            raise CorrmatError(f"no folder {output.parent} to write into")
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


def _config_folder() -> Path:
    """Return configs/exp of the checkout whose script is running."""
    return Path(sys.argv[0]).resolve().parents[1] / "configs" / "exp"


_COMMANDS: dict[str, Callable[[Namespace], int]] = {
    "run": _run,
    "fit": _fit,
    "evaluate": _evaluate,
    "compare": _compare,
    "register": _register,
    "example": _example,
    "data": _data,
    "robustness": _robustness,
    "report": _report,
    "completion": _completion,
}
