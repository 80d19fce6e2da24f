"""`scenegen view`: a page to look at samples with, and at what was predicted of them."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from scenegen.commands.view import page_options, show_page

if TYPE_CHECKING:
    from scenegen.dataset.read import Dataset
    from scenegen.view.look import Layers


@click.command()
@page_options
@click.option(
    "--predictions",
    type=click.Path(path_type=Path),
    help="An HDF5 file of predictions of the split, as `complete` writes: shown beside the truth, with errors marked.",
)
def view(predictions: Path | None, **options: Any) -> None:
    """Write one HTML file that shows samples in three dimensions, without a network."""
    split = options["split"]
    show_page(**options, more=None if predictions is None else lambda dataset: _layers(predictions, dataset, split))


def _layers(path: Path, dataset: "Dataset", split: str) -> "Layers":
    """What the file predicts of a sample, what of it is missed, and what is invented. Raises DatasetError for a file
    that does not predict this split."""
    from scenegen.model.config import Thresholds
    from scenegen.model.evaluation.predicted import Predicted

    predicted = Predicted(path)
    predicted.check(dataset, split)

    def layers(sample: Any, samples: Any) -> dict[str, Any]:
        guess, truth = predicted.completion(sample, samples).occupied(Thresholds()), sample.occupancy
        return {"predicted": guess, "missed": truth & ~guess, "invented": guess & ~truth}

    return layers
