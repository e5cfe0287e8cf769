"""The options of every command: one parser, its help, and what it accepts."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from jsonargparse import ArgumentParser, DefaultHelpFormatter, Namespace

from corrmat import __version__
from corrmat.errors import CorrmatError, short_message

SHORT_HELP = """corrmat: Correspondence Matrices are Underrated (3DV 2020), reproduced.

  corrmat register source.ply target.ply     align two clouds of your own
  corrmat example pair                       write two scans to try it on
  corrmat run --config configs/exp/1.2.yaml  train and test both arms of an experiment
  corrmat data                               make the embedded data set
  corrmat report -o report.html              all records on one page

corrmat --help lists every command, with examples; corrmat COMMAND --help its options."""

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

exit codes: 0 done; 1 interrupted (the same command, without --fresh, continues);
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
  corrmat evaluate --config configs/exp/1.2.yaml --checkpoint 1.2/DCP_corr
  corrmat evaluate --config configs/exp/1.1.yaml --checkpoint best.ckpt --data.rotation_deg 45"""

COMPARE_EPILOG = """examples:
  corrmat compare corrmat,ransac,fgr,icp --protocol real
  corrmat compare corrmat,dcp_v1.t7 --data modelnet40 --root /data --points 1024

What is compared is all of `corrmat register`: the matches of every model, 1.2/DCP too, go
through candidates, choice and ICP. How good a network alone is, corrmat evaluate says.

protocols:
  real    two scans of one shape: no shared point, noise, outliers, normals estimated, and
          each cloud without 30 % of its points
  views   what two depth cameras see of one shape, up to 60 degrees apart
  clean   real without crop and outliers
  dense   two scans of a procedural object, 20,000 points: cropped, or seen by a camera
  rooms   two fragments of a procedural room, 20,000 points, in metres
  paper   the pairs of experiment 1.2

classical pipelines: icp; ransac and fgr, over FPFH features; ransac17, RANSAC with seventeen
candidates, where corrmat's network has up to forty-one; kiss, KISS-Matcher."""

REGISTER_EPILOG = """examples:
  corrmat register scan1.ply scan2.ply
      print the 4 x 4 matrix that takes scan1 onto scan2, and how far to trust it
  corrmat register part.stl scan.pcd -o aligned.ply --json T.json --html view.html
      write the moved source, the result for programs, and a page to look at
  corrmat register front.ply left.ply back.ply -o moved/
      every scan onto the last: all pairs are registered, and the poses that most agree on win
  corrmat register a.npy b.npy --init odometry.txt
      one scan is nearly in place: the guess is one more candidate
      (with --model icp the only one)
  corrmat register a.npy b.npy --model ransac
      the classical pipeline instead (pip install -e '.[baselines]' in corrmat's folder)

Files: PLY, OBJ, STL, OFF, GLB, GLTF (meshes are sampled, scenes merged), PCD, XYZ, TXT, CSV,
ASC, PTS, NPY, NPZ, BIN (as KITTI's). Both files must have the same unit, whichever it is.
Parts may be missing from either.

verdict: "aligned" from a confidence of 94 % on, "probably aligned" from 50 %, else "doubtful".
It was fitted on simulated pairs of objects and rooms: look at --html before you rely on it.
exit codes: 0 done, whatever the verdict; 2 a file cannot be used, and one line says why."""

# The library's own choices; importing those would import torch.
Scale = Literal["smoke", "laptop", "overnight", "paper"]
Logger = Literal["none", "csv", "wandb"]
Protocol = Literal["paper", "real", "views", "clean", "dense", "rooms"]
DEFAULT = "(default: %(default)s)"  # argparse fills it in
RESULTS_HELP = f"folder of the records {DEFAULT}"
SEED_HELP = f"seed of the random draws {DEFAULT}"
EXPERIMENT_COMMANDS = ("run", "fit", "evaluate")


class HelpFormatter(DefaultHelpFormatter, argparse.RawDescriptionHelpFormatter):
    """Add to every setting of a recipe its type, and its default where no recipe says another."""

    def _get_help_string(self, action: argparse.Action) -> str:
        is_setting = "." in action.dest
        return super()._get_help_string(action) if is_setting else action.help or ""


def parse(words: Sequence[str]) -> Namespace:
    """Parse a command line.

    Returns:
        The command's options with the command's name as `command`. Settings of a recipe are not
        among them: those that were given are in `overrides`, nested.

    Raises:
        CorrmatError: an option is unknown or missing, or a value is not valid.
    """
    command = words[0] if words and words[0] in EXPERIMENT_COMMANDS else None
    _check_dotted(words, settings=command is not None)
    parser = build_parser([command] if command else [])
    try:
        parsed = parser.parse_args(list(words))
        given = parser.parse_args(list(words), defaults=False) if command else Namespace()
    except argparse.ArgumentError as error:
        text = short_message(error)
        name = "corrmat"
        if words and not words[0].startswith("-") and "argument command" not in text:
            name += f" {words[0]}"
            text = text.replace(f"{words[0]}.", "")  # "register.source"
        raise CorrmatError(f"{text}; see {name} --help") from error
    options = parsed[parsed.command]
    options.command = parsed.command
    if command:
        from corrmat.training.recipe import GROUPS

        settings = given[parsed.command].as_dict()
        options.overrides = {k: v for k, v in settings.items() if k in ("seed", "start", *GROUPS)}
    return options


def _check_dotted(words: Sequence[str], *, settings: bool) -> None:
    """Refuse options like --seed.foo, which jsonargparse takes for --seed.

    Args:
        words: of the command line.
        settings: whether the command takes the settings of a recipe, which are dotted.

    Raises:
        CorrmatError: an option is dotted, but is no setting of a recipe.
    """
    dotted = [word.split("=")[0] for word in words if word.startswith("--")]
    dotted = [option for option in dotted if "." in option]
    if dotted and settings:
        from corrmat.training.recipe import GROUPS

        dotted = [option for option in dotted if option[2:].split(".")[0] not in GROUPS]
    if dotted:
        raise CorrmatError(f"unknown option {dotted[0]}; see corrmat {words[0]} --help")


def build_parser(with_settings: Sequence[str] = ()) -> ArgumentParser:
    """Build the parser of every command.

    Args:
        with_settings: commands that get the typed settings of recipes, whose import takes seconds.
    """
    parser = ArgumentParser(
        prog="corrmat",
        version=__version__,
        description="Correspondence Matrices are Underrated (3DV 2020), reproduced.",
        epilog=EPILOG,
        formatter_class=HelpFormatter,
        exit_on_error=False,
        allow_abbrev=False,  # a typo is not a choice
    )
    commands = parser.add_subcommands(dest="command", metavar="command")

    def add(name: str, purpose: str, epilog: str = "", words: str = "") -> ArgumentParser:
        """Add a command; `words` are those that its usage names before the options."""
        usage = " ".join(["corrmat", name, *words.split(), "[options]"])
        command = ArgumentParser(
            description=purpose, epilog=epilog, formatter_class=HelpFormatter,
            exit_on_error=False,
            usage=usage,
        )  # fmt: skip
        commands.add_subcommand(name, command, help=purpose)
        return command

    _add_experiment_options(
        add("run", "train and test every arm, write a record, print it beside the paper's",
            RUN_EPILOG, "--config FILE"), "run", with_settings,
    )  # fmt: skip
    _add_experiment_options(
        add("fit", "train one arm", FIT_EPILOG, "--config FILE"),
        "fit", with_settings,
    )  # fmt: skip
    _add_experiment_options(
        add("evaluate", "test the checkpoint of one arm", EVALUATE_EPILOG,
            "--config FILE"), "evaluate", with_settings,
    )  # fmt: skip
    _add_compare_options(
        add("compare", "compare models on the same frozen pairs", COMPARE_EPILOG, "MODELS")
    )
    _add_register_options(
        add(
            "register",
            "align two clouds of your own",
            REGISTER_EPILOG,
            "SOURCE [SOURCE ...] TARGET",
        )
    )
    export = add(
        "export", "write weights as a folder for the Hugging Face Hub",
        "examples:\n  corrmat export mine --model best.ckpt && hf upload somebody/mine mine\n"
        "  corrmat register a.ply b.ply --model mine\n"
        "  corrmat register a.ply b.ply --model hf:somebody/mine", "FOLDER",
    )  # fmt: skip
    export.add_argument("folder", type=Path, help="for model.safetensors, config.json, README.md")
    export.add_argument(
        "--model", default="corrmat",
        help=f"corrmat, 1.2/DCP_corr, ..., or a checkpoint file {DEFAULT}",
    )  # fmt: skip
    example = add("example", "write two scans to try register on", words="FOLDER")
    example.add_argument("folder", type=Path, help="for source.ply, target.ply and truth.json")
    robustness = add("robustness", "figure 2: wrong matches against a wrong rotation vector")
    robustness.add_argument(
        "--scale", type=Scale, default="laptop",
        help="smoke: 20 draws a point of a curve; any other: 400, in results/laptop, since nothing "
        f"is trained {DEFAULT}",
    )  # fmt: skip
    robustness.add_argument("--results", type=Path, default=Path("results"), help=RESULTS_HELP)
    robustness.add_argument("--seed", type=_count, default=0, help=SEED_HELP)
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
    report.add_argument("results", nargs="?", type=Path, default=Path("results"), help=RESULTS_HELP)
    report.add_argument("-o", "--output", type=Path, help="write all records as one HTML page")
    report.add_argument(
        "--docs", type=Path, help="folder of README.md and docs/: rewrite tables, redraw pictures"
    )
    completion = add("completion", "print a script that completes words in a shell", words="SHELL")
    completion.add_argument("shell", type=Literal["bash", "zsh", "tcsh"])
    return parser


def _add_experiment_options(
    parser: ArgumentParser, name: str, with_settings: Sequence[str]
) -> None:
    """Add the options of run, fit and evaluate."""
    parser.add_argument("--config", type=Path, help="the experiment, e.g. configs/exp/1.1.yaml")
    parser.add_argument(
        "--scale", type=Scale, default="laptop", help=f"how large, how long {DEFAULT}"
    )
    parser.add_argument(
        "--runs", type=Path, default=Path("runs"), help=f"folder of checkpoints {DEFAULT}"
    )
    if name in ("run", "fit"):
        parser.add_argument(
            "--logger", type=Logger, default="wandb",
            help="wandb: CSV and wandb offline; csv; none. The record is written in any case "
            f"{DEFAULT}",
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
        parser.add_argument("--results", type=Path, default=Path("results"), help=RESULTS_HELP)
    else:
        parser.add_argument("--arm", help="one of the recipe's arms (default: its METHOD_corr)")
    if name == "evaluate":
        parser.add_argument(
            "--checkpoint", type=Path,
            help="weights to test, as --model of corrmat register takes them (default: best.ckpt "
            "of the arm's last fit or run)",
        )  # fmt: skip
    if name in with_settings:
        from corrmat.training.recipe import add_settings

        add_settings(parser)


def _add_compare_options(parser: ArgumentParser) -> None:
    """Add the options of compare."""
    parser.add_argument("models", help="e.g. corrmat,ransac,fgr,icp or checkpoint files")
    parser.add_argument("--protocol", type=Protocol, default="real", help=f"see below {DEFAULT}")
    parser.add_argument(
        "--data", default="shapes",
        help=f"shapes, assemblies, rooms, modelnet40 or folder {DEFAULT}",
    )  # fmt: skip
    parser.add_argument("--root", type=Path, help="folder of the data set")
    parser.add_argument(
        "--points", type=_positive,
        help="points of a cloud before it is cropped (default: 20,000 of scans, else 512)",
    )  # fmt: skip
    parser.add_argument("--pairs", type=_positive, default=120, help=f"number of pairs {DEFAULT}")
    parser.add_argument(
        "--record", type=Path, metavar="JSON", help="write the table and the values of each pair"
    )


def _add_register_options(parser: ArgumentParser) -> None:
    """Add the options of register."""
    parser.add_argument(
        "source", type=Path, nargs="+", help="the cloud or mesh that is moved, or several"
    )
    parser.add_argument("target", type=Path, help="the cloud or mesh that they are moved onto")
    parser.add_argument(
        "-o", "--output", type=Path, metavar="PLY",
        help="write the moved source as a PLY, with the faces, and the colours of a PLY or PCD; "
        "the folder to write them into, if there are several",
    )  # fmt: skip
    parser.add_argument(
        "--json", type=Path, help="write matrix, confidence and verdict; - is standard output"
    )
    parser.add_argument("--html", type=Path, help="write a page: before, matches, after")
    parser.add_argument("--gif", type=Path, help="write an animation of the same")
    parser.add_argument(
        "--model", default="corrmat",
        help="corrmat (the shipped weights), icp, ransac, ransac17, fgr, kiss, a shipped arm "
        "(1.2/DCP_corr), a checkpoint file, a folder of corrmat export, or hf:name/model "
        f"{DEFAULT}",
    )  # fmt: skip
    parser.add_argument(
        "--refine", type=Literal["icp", "none"], default="icp",
        help=f"refinement after the model {DEFAULT}",
    )  # fmt: skip
    parser.add_argument(
        "--init", type=Path, metavar="MATRIX",
        help="a first guess, one more candidate, or the only one of icp: 4 lines of 4 numbers, or "
        "what --json wrote",
    )  # fmt: skip
    parser.add_argument("--seed", type=_count, default=0, help=SEED_HELP)


def _count(text: str) -> int:
    """Parse a seed or a number of things."""
    try:
        value = int(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number") from error
    if not 0 <= value < 2**32:
        raise argparse.ArgumentTypeError(f"{value} is not between 0 and 2^32")
    return value


def _positive(text: str) -> int:
    value = _count(text)
    if not value:
        raise argparse.ArgumentTypeError("must be at least 1")
    return value
