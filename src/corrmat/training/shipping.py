"""The trained arms of a recorded experiment become weights of the package."""

from pathlib import Path

from corrmat import weights
from corrmat.reporting.record import read_record
from corrmat.training.preflight import prepare
from corrmat.training.recipe import SCALES, Recipe
from corrmat.training.runs import recorded_checkpoint

MAX_PARAMETERS = 2_000_000  # PCRNet's pose network, of 17 MB, is left out


def ship_arms(recipe: Recipe, results: Path, runs_folder: Path) -> list[str]:
    """Write the weights of METHOD and METHOD_corr that a record was tested with into the package.

    Only seed 0 on the embedded shapes ships; weights of a larger scale that ship already are kept.

    Args:
        recipe: the experiment.
        results: folder of records; without this one nothing is shipped.
        runs_folder: folder of checkpoints; arms that were not recorded, or were trained anew
            since, are left out.

    Returns:
        Names for `load_model`.
    """
    path = results / recipe.place / "metrics.json"
    if recipe.networks_of or not path.is_file():
        return []
    shipped = []
    for name in filter(None, (recipe.baseline, recipe.treatment)):
        settings = recipe.arms[name]
        if recipe.data != "shapes" or settings.seed:
            continue
        model = f"{recipe.id}/{name}"
        if model in weights.shipped_models() and _shipped_scale(model) > SCALES.index(recipe.scale):
            continue
        checkpoint = recorded_checkpoint(recipe, prepare(settings), runs_folder)
        if checkpoint is None:
            continue
        _, hparams, network = weights.checkpoint_network(checkpoint)
        if sum(p.numel() for p in network.parameters()) > MAX_PARAMETERS:
            continue
        trained_at = str(read_record(path).arms[name].trained_at)
        weights.ship_network(
            model, settings.method, hparams, network,
            commit=trained_at, record=recipe.place.as_posix(), arm=name,
        )  # fmt: skip
        shipped.append(model)
    return shipped


def _shipped_scale(model: str) -> int:
    """Return the place in `SCALES` of the record of weights that ship."""
    return SCALES.index(Path(weights.shipped_metadata(model)["record"]).parts[0])
