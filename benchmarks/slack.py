"""What RPMNet's alpha does where the source is cropped (experiment 2.2).

    python benchmarks/slack.py "overnight, shapes" 2.2/RPMNet_corr shapes
    python benchmarks/slack.py "laptop, modelnet40" CHECKPOINT modelnet40 ROOT

A target point without a match gives its share of the matrix to the slack row, which scores 0
against -beta (distance^2 - alpha) of the source points. Where alpha exceeds every distance^2 the
slack row gets nothing, and the share goes to source points that do not match. This tests a network
with its own alpha and with alpha held, and adds a table of medians to results/slack.json.
"""

import sys
from pathlib import Path

import torch

from corrmat.files import update_json
from corrmat.metrics import rotation_error_deg
from corrmat.networks.rpmnet import AnnealingNet, RPMNetwork
from corrmat.progress import track
from corrmat.revision import commit
from corrmat.training.preflight import prepare
from corrmat.training.recipe import load
from corrmat.types import PairBatch
from corrmat.weights import load_model

ROOT = Path(__file__).resolve().parents[1]
PATH = ROOT / "results" / "slack.json"
HELD = 0.0, 0.1, 1.0


class AlphaHolder:
    """A forward hook of the annealing network: holds alpha, if it is given, and keeps both said."""

    def __init__(self, alpha: float | None) -> None:
        self.alpha = alpha

    def __call__(
        self, annealing: AnnealingNet, inputs: object, output: tuple[torch.Tensor, torch.Tensor]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Keep beta and alpha, (B,) each, and return what the network goes on with."""
        beta, alpha = output
        self.said = torch.stack([beta, alpha], 1)
        return beta, alpha if self.alpha is None else torch.full_like(alpha, self.alpha)


def errors_of(network: RPMNetwork, holder: AlphaHolder, batch: PairBatch) -> torch.Tensor:
    """Measure the pairs of a batch.

    Returns:
        (B, 5): degrees, units of translation, mean probability of the true match, beta, alpha.
    """
    prediction = network(batch.source, batch.target)
    assert prediction.correspondence is not None
    prob = prediction.correspondence.prob()
    inlier = batch.match < prob.shape[2]
    true = prob.gather(2, batch.match.clamp(max=prob.shape[2] - 1).unsqueeze(2)).squeeze(2)
    columns = (
        rotation_error_deg(prediction.rotation, batch.rotation),
        (prediction.translation - batch.translation).norm(dim=-1),
        (true * inlier).sum(1) / inlier.sum(1),
        *holder.said.unbind(1),
    )
    return torch.stack([column.double() for column in columns], 1)


@torch.no_grad()
def main(name: str, model: str, data: str, root: str | None = None) -> None:
    """Test a network with its own alpha and with alpha held, and write the medians.

    Args:
        name: of the network in the table.
        model: shipped network or checkpoint.
        data: to test on.
        root: folder of the data set.
    """
    today = commit()
    network = load_model(model).eval()
    assert isinstance(network, RPMNetwork)
    overrides = {"data": {"data": data, "root": root}}
    recipe = load(ROOT / "configs" / "exp" / "2.2.yaml", "laptop", overrides, ["RPMNet_corr"])
    datamodule = prepare(recipe.arms["RPMNet_corr"]).datamodule
    datamodule.setup("test")
    rows = {}
    for alpha in (None, *HELD):
        holder = AlphaHolder(alpha)
        hook = network.annealing.register_forward_hook(holder)
        batches = track(datamodule.test_dataloader(), f"alpha {alpha}")
        errors = torch.cat([errors_of(network, holder, batch) for batch in batches])
        hook.remove()
        keys = "rotation_error_deg", "translation_error", "true_match_prob", "beta", "alpha"
        medians = [round(value, 4) for value in errors.median(0).values.tolist()]
        rows["its own" if alpha is None else str(alpha)] = dict(zip(keys, medians, strict=True))
        print(f"{name}, alpha {alpha}: {medians}", flush=True)
    update_json(PATH, name, {"commit": today, "pairs": len(errors), "alpha": rows})


if __name__ == "__main__":
    main(*sys.argv[1:])
