"""What the scripts of reproduce/ run; their options are those of `corrmat run`."""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from jsonargparse import Namespace, auto_cli

from corrmat.cli import exit_code, fit_arm, main, prepare_output
from corrmat.options import parse


def reproduce(experiment: str) -> None:
    """Run the experiment of this id with the caller's options: all that reproduce/exp*.py do."""
    config = _config_folder() / "exp" / f"{experiment}.yaml"
    sys.exit(main(["run", "--config", str(config), *sys.argv[1:]]))


def train_on_ray() -> None:
    """Train every arm of every experiment on a Ray cluster: reproduce/on_ray.py."""

    def run() -> int:
        options, configs = _script_options()
        from corrmat.training import cluster

        cluster.train_all(
            configs, options.scale, options.overrides, options.runs, options.logger,
            fresh=options.fresh,
        )  # fmt: skip
        return 0

    sys.exit(exit_code(run))


def sweep_rates(experiments: Sequence[str]) -> None:
    """Choose the rates of these experiments' arms, or of --config's: reproduce/rates.py."""

    def run() -> int:
        options, configs = _script_options(experiments)
        from corrmat.training import rates, recipe

        for path in configs:
            loaded = recipe.load(path, options.scale, options.overrides)
            rates.sweep(loaded, options.results, options.runs, options.logger, fresh=options.fresh)
        return 0

    sys.exit(exit_code(run))


def ship_arms() -> None:
    """Put the trained arms of recorded experiments into the package: reproduce/checkpoints.py."""

    def run() -> int:
        options, configs = _script_options()
        from corrmat.training import recipe, shipping

        for path in configs:
            loaded = recipe.load(path, options.scale, options.overrides)
            for name in shipping.ship_arms(loaded, options.results, options.runs):
                print(f"shipped: {name}")
        return 0

    sys.exit(exit_code(run))


def train_weights() -> None:
    """Train the weights that `corrmat register` ships: reproduce/weights.py.

    Only weights of the laptop scale, trained on the embedded shapes, are shipped.
    """

    def run() -> int:
        words = ["fit", "--config", str(_config_folder() / "weights.yaml"), *sys.argv[1:]]
        options = _parse(words)
        from corrmat.registration import shipping
        from corrmat.training import hardware, recipe, runs

        loaded = recipe.load(options.config, options.scale, options.overrides)
        shipped = recipe.load(_config_folder() / "weights.yaml", "laptop")
        ships = (loaded.id, loaded.scale, loaded.data) == (shipped.id, "laptop", shipped.data)
        arm = loaded.arms[loaded.treatment]
        results = _config_folder().parent / "results"
        if ships and arm.start == "corrmat":
            shipping.refuse_used_seed(results, arm.seed)
        fit_arm(options)
        if ships and hardware.is_first_process():
            folder = options.runs / loaded.place / arm.name
            facts = runs.trained_facts(folder)
            shipping.ship(folder / "last.ckpt", facts, results, start=arm.start, seed=arm.seed)
            runs.mark_recorded(folder)  # the next run starts from these weights
        return 0

    sys.exit(exit_code(run))


def call(function: Callable[..., None]) -> None:
    """Call a function with the script's options: reproduce/verification.py, calibration.py."""

    def run() -> int:
        from corrmat.training.console import print_messages

        print_messages(0)
        auto_cli(function)
        return 0

    sys.exit(exit_code(run))


def _script_options(experiments: Sequence[str] = ()) -> tuple[Namespace, list[Path]]:
    """Parse a script's options, those of `run`; list the recipes that it goes through.

    Args:
        experiments: ids; without any, all of them. --config names one in their place.
    """
    options = _parse(["run", *sys.argv[1:]])
    prepare_output(options)
    folder = _config_folder() / "exp"
    listed = [folder / f"{name}.yaml" for name in experiments] or sorted(folder.glob("*.yaml"))
    return options, [options.config] if options.config else listed


def _parse(words: Sequence[str]) -> Namespace:
    """Parse a command's words; --help says first what the script does."""
    if {"-h", "--help"} & set(words):
        print(f"{sys.modules['__main__'].__doc__}\nIts options are those of corrmat {words[0]}:\n")
    return parse(words)


def _config_folder() -> Path:
    """Return configs/ of the checkout whose script is running."""
    return Path(sys.argv[0]).resolve().parents[1] / "configs"
