"""Whether an ensemble earns its cost: several networks of one kind, each alone, and the mean of
what they say.

    python benchmarks/ensemble.py data/geometric data/pillar --weights runs/a --weights runs/b

Probabilities have their class weight inverted for NLL and Brier, which are over unknown voxels.
Differences, with 95 % intervals over worlds, are from the mean of the single networks.
"""

from typing import Any

import measuring
import numpy as np

from scenegen.dataset.read import Dataset
from scenegen.model.calibration import corrected
from scenegen.model.completion.completer import Completer
from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import LossConfig
from scenegen.model.evaluation.metrics import METRICS, measure_whole
from scenegen.model.evaluation.statistics import figure, interval
from scenegen.model.evaluation.visibility import UNOBSERVED, classify
from scenegen.truth import distance_field

SHOWN = ("iou", "near_rmse")


def main() -> None:
    """Print a line for each dataset and figure."""
    parser = measuring.options(__doc__)
    parser.add_argument("datasets", nargs="+")
    parser.add_argument("--weights", action="append", required=True)
    parser.add_argument("--maps", type=int, default=60)
    options = measuring.parse(parser, maps=2)
    members = [Completer.from_pretrained(name) for name in options.weights]
    for folder in options.datasets:
        split = Dataset(folder).split("test")
        numbers = range(min(options.maps, len(split)))
        found = np.array(
            [_measured(members, split, n) for n in numbers]
        )  # maps, members and their mean, figures
        worlds = [split[n].world for n in numbers]
        for m, name in enumerate((*SHOWN, "nll", "brier")):
            alone, mean = found[:, :-1, m], found[:, -1, m]
            gain = figure(mean - alone.mean(axis=1), worlds)
            cells = " ".join(f"{value:.4f}" for value in alone.mean(axis=0))
            print(
                f"{split.dataset.manifest.kind:10} {name:10} alone {cells}  together "
                f"{mean.mean():.4f} "
                f"({gain['mean']:+.4f} {interval(gain, '+.4f')})"
            )


def _measured(members: list[Completer], split: Any, number: int) -> list[list[float]]:
    """The figures of one map: of each member, and of their mean."""
    sample, grid = split[number], split.dataset.grid
    said = [completer(sample) for completer in members]
    parts = [
        np.mean([getattr(one, name) for one in said], axis=0)
        for name in ("occupancy_probability", "tudf")
    ]
    classes = classify(sample, grid=grid)
    unknown, truth = np.isin(classes, UNOBSERVED), distance_field(sample.occupancy, grid)
    weight = LossConfig().occupied_weight
    rows = []
    for one in (*said, Prediction(*parts)):
        metrics = measure_whole(one, sample.occupancy, truth, grid)
        chance = corrected(one.occupancy_probability, weight)[unknown].astype(np.float64)
        true = sample.occupancy[unknown]
        right = np.clip(np.where(true, chance, 1 - chance), 1e-7, 1)
        rows.append(
            [
                *(metrics[list(METRICS).index(name)] for name in SHOWN),
                -np.log(right).mean(),
                ((1 - right) ** 2).mean(),
            ]
        )
    return rows


if __name__ == "__main__":
    main()
