"""The trained arms of a recorded experiment become weights of the package."""

from pathlib import Path

from corrmat import weights
from corrmat.reporting.record import read_record
from corrmat.training.preflight import prepare
from corrmat.training.recipe import Recipe
from corrmat.training.runs import best_checkpoint

MAX_PARAMETERS = 2_000_000  # PCRNet's pose network, of 17 MB, is left out


def ship(recipe: Recipe, results: Path, runs_folder: Path) -> list[str]:
    """Write the weights that an experiment's record was tested with into the package.

    Args:
        recipe: the experiment.
        results: folder of records; without this one nothing is shipped.
        runs_folder: folder of checkpoints; arms without one are left out.

    Returns:
        Names for `load_model`.
    """
    path = results / recipe.place / "metrics.json"
    if recipe.networks_of or not path.is_file():
        return []
    shipped = []
    for name, settings in recipe.arms.items():
        checkpoint = best_checkpoint(recipe, prepare(settings), runs_folder)
        if not checkpoint.is_file():
            continue
        _, hparams, network = weights.checkpoint_network(checkpoint)
        if sum(p.numel() for p in network.parameters()) > MAX_PARAMETERS:
            continue
        model = f"{recipe.id}/{name}"
        trained_at = str(read_record(path).arms[name].trained_at)
        weights.ship_network(
            model, settings.method, hparams, network,
            commit=trained_at, record=recipe.place.as_posix(), arm=name,
        )  # fmt: skip
        shipped.append(model)
    return shipped
