"""The command line: corrmat register, example, run, fit, evaluate, robustness, data, report."""

import argparse
import os
import sys
from pathlib import Path

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
  corrmat evaluate --models corrmat,ransac,fgr,icp --protocol real
      the shipped weights beside the classical pipelines, on the same frozen pairs
  corrmat robustness
      figure 2 of the paper: curve and picture in results/laptop/robustness
  corrmat data --sheet shapes.png
      make the embedded data set, draw its families

  eval "$(corrmat completion bash)"
      commands, options and files by the tab key (zsh, tcsh: the same)

Whatever a recipe sets can be set here: --data.*, --network.*, --optimizer.*, --trainer.*
(Lightning's own Trainer) and --seed; corrmat fit --help lists them all with their types.

exit codes: 0 done; 1 interrupted (the same command goes on from its checkpoint);
2 something given cannot be used, and one line says what."""


EXPERIMENT_COMMANDS = {
    "run": (
        "train and test every arm, write a record, print it beside the paper's",
        """examples:
  corrmat run --config configs/exp/1.2.yaml
  corrmat run --config configs/exp/1.2.yaml --scale smoke --logger none -q
  corrmat run --config configs/exp/1.1.yaml --data.data modelnet40 --data.root /data""",
    ),
    "fit": (
        "train one arm",
        """examples:
  corrmat fit --config configs/exp/1.1.yaml
  corrmat fit --config configs/exp/2.2.yaml --arm RPMNet --trainer.max_steps 500
  corrmat fit --config configs/exp/outliers.yaml --arm DCP_corr --network.outlier dustbin
Ctrl-C saves a checkpoint; the same command goes on from it.""",
    ),
    "evaluate": (
        "test the checkpoint of one arm, or compare models on pairs of a protocol",
        """examples:
  corrmat evaluate --config configs/exp/1.1.yaml
  corrmat evaluate --config configs/exp/1.1.yaml --checkpoint best.ckpt --data.rotation_deg 45
  corrmat evaluate --models corrmat,ransac,fgr,icp --protocol real
  corrmat evaluate --models corrmat,dcp_v1.t7 --data modelnet40 --root /data --points 1024""",
    ),
}

# Options of `evaluate` that belong to --models, and what they are if not given.
OF_MODELS = {
    "protocol": "real", "data": "shapes", "root": None, "points": 512, "pairs": 120, "record": None,
}  # fmt: skip

REGISTER_EPILOG = """examples:
  corrmat register scan1.ply scan2.ply
      print the 4 x 4 matrix that takes scan1 onto scan2, and how far to trust it
  corrmat register part.stl scan.pcd -o aligned.ply --json T.json --html view.html
      write the moved source, the result for programs, and a page to look at
  corrmat register a.npy b.npy --model ransac
      the classical pipeline instead (pip install open3d)

Files: PLY, OBJ, STL, OFF, GLB, GLTF (meshes are sampled, scenes merged), PCD, XYZ, TXT, CSV,
NPY, NPZ. Any units, as long as both files have the same. Parts may be missing from either.

exit codes: 0 done, whatever the verdict; 2 a file cannot be used, and one line says why."""


def main(arguments: list[str] | None = None) -> int:
    """Run a command; errors of the user's making are one line, never a traceback."""
    words = sys.argv[1:] if arguments is None else arguments
    try:
        return _command(words)
    except CorrmatError as error:
        print(f"corrmat: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("corrmat: interrupted; nothing was recorded", file=sys.stderr)
        return 1
    except BrokenPipeError:  # whoever read our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:  # a full disk, a folder that is somebody else's
        print(f"corrmat: error: {error}", file=sys.stderr)
        return 2


def reproduce(experiment: str) -> None:
    """Run the experiment of this id with the caller's options: all that reproduce/*.py do."""
    config = Path(sys.argv[0]).resolve().parents[1] / "configs" / "exp" / f"{experiment}.yaml"
    sys.exit(main(["run", "--config", str(config), *sys.argv[1:]]))


def _command(words: list[str]) -> int:
    known, options = parser().parse_known_args(words)
    plain = {
        "register": lambda: _register(known),
        "example": lambda: _example(known.folder),
        "data": lambda: _data(known),
        "robustness": lambda: _robustness(known.scale, known.results, known.seed),
        "report": lambda: _report(known.results, known.output, known.docs),
        "completion": lambda: _completion(known.shell),
    }
    if known.command not in plain:
        return _experiment(known, options)
    _refuse(options)
    return plain[known.command]()


def parser() -> argparse.ArgumentParser:
    """The command line, but for the settings of recipes, which are left over."""
    found = argparse.ArgumentParser(
        "corrmat",
        description="Correspondence Matrices are Underrated (3DV 2020), reproduced.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    raw = argparse.RawDescriptionHelpFormatter
    commands = found.add_subparsers(dest="command", metavar="command", required=True)
    for name, (purpose, examples) in EXPERIMENT_COMMANDS.items():
        command = commands.add_parser(
            name, help=purpose, description=purpose, add_help=False, allow_abbrev=False,
            epilog=examples, formatter_class=raw,
        )  # fmt: skip
        _experiment_options(command, name)
    _register_options(commands.add_parser(
        "register", help="align two clouds of your own", epilog=REGISTER_EPILOG,
        formatter_class=raw,
    ))  # fmt: skip
    example = commands.add_parser("example", help="write two scans to try register on")
    example.add_argument("folder", type=Path, help="for source.ply, target.ply and truth.json")
    figure = commands.add_parser(
        "robustness", help="figure 2: wrong matches against a wrong rotation vector"
    )
    figure.add_argument("--scale", default="laptop", choices=["smoke", "laptop", "paper"],
        help="smoke: 20 draws a point of a curve instead of 400")  # fmt: skip
    figure.add_argument("--results", type=Path, default=Path("results"), help="folder of records")
    figure.add_argument("--seed", type=_count, default=0, help="of the draws")
    data = commands.add_parser(
        "data", help="make the embedded data set, or fetch ModelNet40",
        epilog="examples:\n  corrmat data --sheet a.png\n  corrmat data modelnet40 --root /data",
        formatter_class=raw,
    )  # fmt: skip
    data.add_argument("name", nargs="?", default="shapes", choices=["shapes", "modelnet40"])
    data.add_argument("--root", type=Path, help="modelnet40: folder to fetch it into")
    data.add_argument("--mirror", action="append", metavar="URL",
        help="modelnet40: where its zip is; may be given more than once")  # fmt: skip
    data.add_argument("--sheet", type=Path, metavar="PNG", help="draw one shape of every family")
    report = commands.add_parser(
        "report", help="one page, or the documents' tables, from results/",
        epilog="examples:\n  corrmat report -o report.html\n  corrmat report results/ --docs .",
        formatter_class=raw,
    )  # fmt: skip
    report.add_argument(
        "results", type=Path, nargs="?", default=Path("results"), help="folder of records"
    )
    report.add_argument("-o", "--output", type=Path, help="write all records as one HTML page")
    report.add_argument(
        "--docs", type=Path, help="folder of README.md and docs/: rewrite tables, redraw pictures"
    )
    completion = commands.add_parser("completion", help="print what makes a shell complete words")
    completion.add_argument("shell", choices=["bash", "zsh", "tcsh"])
    return found


def _count(text: str) -> int:
    """A seed or a number of things."""
    value = int(text)
    if not 0 <= value < 2**32:
        raise argparse.ArgumentTypeError(f"{value} is not between 0 and 2^32")
    return value


def _positive(text: str) -> int:
    value = _count(text)
    if not value:
        raise argparse.ArgumentTypeError("at least 1")
    return value


def _experiment_options(command: argparse.ArgumentParser, name: str) -> None:
    command.add_argument("--help", "-h", action="store_true", help="show every option and its type")
    command.add_argument("--config", type=Path, help="the experiment, e.g. configs/exp/1.1.yaml")
    command.add_argument(
        "--scale", default="laptop", choices=["smoke", "laptop", "paper"], help="default: laptop"
    )
    command.add_argument(
        "--runs", type=Path, default=Path("runs"), help="folder of checkpoints and logs"
    )
    if name in ("run", "fit"):
        command.add_argument(
            "--logger",
            choices=["none", "csv", "wandb"],
            default="wandb",
            help="wandb (default): CSV and wandb offline; csv; none. The record is written anyway",
        )
        command.add_argument(
            "--fresh",
            action="store_true",
            help="train anew, even where a run of the same settings was interrupted or is done",
        )
        loud = command.add_mutually_exclusive_group()
        loud.add_argument("-q", "--quiet", action="store_true", help="print nothing but results")
        loud.add_argument("-v", "--verbose", action="store_true", help="Lightning's messages, too")
    if name == "run":
        command.add_argument(
            "--results", type=Path, default=Path("results"), help="folder of records"
        )
    else:
        command.add_argument(
            "--arm",
            help="one of the recipe's arms, e.g. DCP or DCP_corr (default: its METHOD_corr)",
        )
    if name == "evaluate":
        command.add_argument(
            "--models",
            help="instead of an arm: register pairs of a protocol with these and compare them, "
            "e.g. corrmat,ransac,fgr,icp or checkpoint files",
        )
        command.add_argument(
            "--protocol",
            choices=["paper", "real", "clean"],
            help="with --models. real (default): disjoint samples, noise, crop and outliers in "
            "both; clean: without crop and outliers; paper: experiment 1.2's pairs",
        )
        command.add_argument("--data", choices=["shapes", "modelnet40"],
            help="with --models; default: shapes")  # fmt: skip
        command.add_argument("--root", type=Path, help="with --models: folder of modelnet40")
        command.add_argument("--points", type=_positive,
            help="with --models: points of a cloud before it is cropped; default: 512")  # fmt: skip
        command.add_argument("--pairs", type=_positive, help="with --models; default: 120")
        command.add_argument(
            "--record", type=Path, metavar="JSON",
            help="with --models: write table and per-pair values",
        )  # fmt: skip
        command.add_argument(
            "--checkpoint", type=Path, help="default: best.ckpt of the arm's last fit or run"
        )
    command.set_defaults(usage_text=command.format_help())


def _register_options(command: argparse.ArgumentParser) -> None:
    command.add_argument("source", type=Path, help="the cloud or mesh that is moved")
    command.add_argument("target", type=Path, help="the cloud or mesh that it is moved onto")
    command.add_argument("-o", "--output", type=Path, metavar="PLY",
        help="write the moved source (the points sampled on it, if it is a mesh)")  # fmt: skip
    command.add_argument("--json", type=Path, help="write matrix, confidence and verdict")
    command.add_argument("--html", type=Path, help="write a page: before, after, matches")
    command.add_argument(
        "--model",
        default="corrmat",
        help="corrmat (the shipped weights, default), icp, ransac, fgr, or a checkpoint file",
    )
    command.add_argument(
        "--refine", choices=["icp", "none"], default="icp", help="after the model's guess"
    )
    command.add_argument("--seed", type=_count, default=0, help="of subsampling and of draws")


def _register(known: argparse.Namespace) -> int:
    for path in (known.output, known.json, known.html):
        if path is not None and not path.parent.is_dir():
            raise CorrmatError(f"no folder {path.parent} to write {path.name} into")
    if known.output is not None and known.output.suffix.lower() != ".ply":
        raise CorrmatError(f"the moved source is written as PLY, {known.output} is named otherwise")

    from corrmat.data.scans import read_scan, write_ply
    from corrmat.files import replace_text

    source, target = (read_scan(path, known.seed) for path in (known.source, known.target))

    from corrmat import registration

    found = registration.register(
        source, target, model=known.model, refine=known.refine, seed=known.seed
    )
    print(registration.text(found))
    if known.output is not None:
        rotation, translation = found.transform[:3, :3], found.transform[:3, 3]
        write_ply(known.output, source @ rotation.T + translation)
        print(f"source, moved: {known.output}")
    if known.json is not None:
        replace_text(known.json, registration.json_text(found))
        print(f"result: {known.json}")
    if known.html is not None:
        from corrmat import view  # plotly takes a second to load

        replace_text(known.html, view.page(found, source, target))
        print(f"to look at: {known.html}")
    return 0


def _example(folder: Path) -> int:
    from corrmat.example import write

    write(folder)
    print(
        f"{folder}: source.ply, target.ply and truth.json, two scans of one shape. Now try\n"
        f"  corrmat register {folder / 'source.ply'} {folder / 'target.ply'} "
        f"--html {folder / 'view.html'}"
    )
    return 0


def _experiment(known: argparse.Namespace, options: list[str]) -> int:
    # Imported here, so that --help and mistakes do not wait for torch.
    from corrmat import console, experiment, metrics, recipe
    from corrmat.files import ensure_writable
    from corrmat.methods import METHODS

    if known.help:
        arm = getattr(known, "arm", None)
        if known.config is not None:
            arms = recipe.load(known.config, known.scale, [], [arm] if arm else None).settings
            method = list(arms.values())[-1].method
        else:
            method = arm if arm in METHODS else "DCP_corr"
        print(known.usage_text)
        print(recipe.parser(method).format_help().split("\n\n", 1)[1])
        return 0
    if getattr(known, "models", None):
        _refuse(options)
        return _compare(known)
    for name in OF_MODELS:
        if getattr(known, name, None) is not None:
            raise CorrmatError(f"--{name} goes with --models; a recipe's pairs are --data.*")
    if known.config is None:
        raise CorrmatError("which experiment? --config configs/exp/1.1.yaml")
    wanted = getattr(known, "arm", None)
    arms = [wanted] if wanted else None
    experiment.quieten()
    loud = getattr(known, "verbose", False) - getattr(known, "quiet", False)
    console.listen(loud if experiment.first_process() else -1)
    found = recipe.load(known.config, known.scale, options, arms)
    if known.command == "run":
        experiment.run(found, known.results, known.runs, known.logger, fresh=known.fresh)
        return 0
    name = next((arm for arm in found.settings if arm.endswith("_corr")), list(found.settings)[-1])
    arm = experiment.prepare(name, found.settings[name])
    folder = known.runs / found.scale / found.data / found.id / name
    if known.command == "fit":
        group = f"{found.scale}/{found.data}/{found.id}"
        ensure_writable(folder)
        trained = None if known.fresh else experiment.trained_already(found, arm, known.runs)
        with console.Board() as board:
            trained = trained or experiment.train(
                arm, folder, group, known.logger, board, fresh=known.fresh
            )
        print(f"best checkpoint: {trained.checkpoint}")
        return 0
    checkpoint = known.checkpoint or experiment.best_checkpoint(found, arm, known.runs)
    module = experiment.trained_module(arm, checkpoint)
    print(f"checkpoint: {checkpoint}")
    tests = experiment.score(module, arm, experiment.bands(found.bands_deg))
    for number, pairs in enumerate(tests):
        if found.bands_deg:
            print(f"\n{found.bands_deg[number]:g} to {found.bands_deg[number + 1]:g} deg")
        for name, value in metrics.summary(pairs).items():
            print(f"{name:28s} {value:.6g}")
    return 0


def _compare(known: argparse.Namespace) -> int:
    from corrmat import comparison
    from corrmat.files import ensure_writable

    for name in ("config", "arm", "checkpoint"):
        if getattr(known, name) is not None:
            raise CorrmatError(
                f"--{name} cannot be combined with --models, which uses a protocol's pairs"
            )
    given = {name: getattr(known, name) for name in OF_MODELS}
    how = {name: OF_MODELS[name] if value is None else value for name, value in given.items()}
    record, count, root = how.pop("record"), how.pop("pairs"), how.pop("root")
    if record is not None:
        ensure_writable(record.parent)
    pairs = comparison.frozen_pairs(**how, root=root, count=count)
    found = comparison.compare(pairs, known.models.split(","))
    print(f"{len(pairs)} pairs")
    print(comparison.table(found))
    if record is not None:
        comparison.write(record, found, **how, pairs=len(pairs))
        print(f"record: {record}")
    return 0


def _data(known: argparse.Namespace) -> int:
    if known.name == "shapes" and (known.root or known.mirror):
        raise CorrmatError("--root and --mirror go with modelnet40: corrmat data modelnet40 ...")
    if known.sheet is not None and (known.name != "shapes" or not known.sheet.parent.is_dir()):
        raise CorrmatError(
            f"--sheet {known.sheet}: draws the embedded shapes, into an existing folder"
        )
    if known.name == "modelnet40":
        from corrmat import console
        from corrmat.data import modelnet40

        if known.root is None:
            raise CorrmatError("where to? --root folder")
        console.listen(0)
        folder = modelnet40.fetch(known.root, known.mirror or (modelnet40.SOURCE,))
        print(f"{folder}: whole and readable; use it with DATA=modelnet40 ROOT={known.root}")
        return 0

    from corrmat.data import shapes

    for split in shapes.SIZE:
        clouds = shapes.load(split)
        print(
            f"{split}: {len(clouds)} shapes of {len(clouds.names)} families, "
            f"kept in {shapes.cache_folder()}"
        )
    if known.sheet is not None:
        from corrmat.data.sheet import draw

        draw(shapes.load("train"), known.sheet)
        print(f"drawn: {known.sheet}")
    return 0


def _completion(shell: str) -> int:
    import shtab

    from corrmat import recipe

    own = parser()
    commands = next(a for a in own._actions if isinstance(a, argparse._SubParsersAction))
    typed = [name for a in recipe.parser("DCP_corr")._actions for name in a.option_strings]
    for command in ("run", "fit", "evaluate"):
        for name in typed:
            if "." in name or name == "--seed":
                commands.choices[command].add_argument(name, metavar="VALUE")
    print(shtab.complete(own, shell))
    return 0


def _robustness(scale: str, results: Path, seed: int) -> int:
    from corrmat import robustness
    from corrmat.files import ensure_writable

    folder = results / scale / "robustness"
    ensure_writable(folder)
    found = robustness.run(folder, draws=20 if scale == "smoke" else 400, seed=seed)
    print("rotation error, mean, deg, where so many per cent are corrupted:\n")
    print(robustness.terminal_table(found))
    print(f"\nrecord: {folder}")
    return 0


def _report(results: Path, output: Path | None, docs: Path | None) -> int:
    from corrmat import report

    if output is None and docs is None:
        raise CorrmatError("what to write? -o report.html, or --docs . for the documents' tables")
    if not report.read_records(results):
        raise CorrmatError(f"no records in {results}; run an experiment first")
    if output is not None:
        from corrmat import page
        from corrmat.files import replace_text

        if not output.parent.is_dir():
            raise CorrmatError(f"no folder {output.parent} to write into")
        content = page.build(results)
        replace_text(output, content)
        print(f"{output}: {len(content) / 1e6:.1f} MB, open it in a browser")
    if docs is not None:
        from corrmat import record

        records = report.read_records(results, scale="laptop")
        for found in records:
            record.draw(results / found["scale"] / found["data"] / found["id"])
        pages = docs / "README.md", docs / "docs" / "reproduction.md"
        report.refresh(pages[0], "results", report.markdown_summary(records))
        report.refresh(pages[0], "register", report.markdown_register(results))
        networks = report.markdown_networks(results)
        report.refresh(docs / "docs" / "register.md", "networks", networks)
        confidence = report.markdown_confidence(results)
        report.refresh(docs / "docs" / "register.md", "confidence", confidence)
        report.refresh(docs / "docs" / "speed.md", "bench", report.markdown_bench(results))
        report.refresh(pages[1], "tables", report.markdown_tables(records))
        print(f"{len(records)} records -> {pages[0]}, {pages[1]}")
    return 0


def _refuse(options: list[str]) -> None:
    if options:
        raise CorrmatError(f"unknown option {options[0]!r}; see corrmat --help")
