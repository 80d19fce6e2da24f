"""What a network loses where less is known of a scan than a dataset's sample tells.

    python benchmarks/points.py data/geometric data/pillar --weights columns

The same test maps three times: the sample with all that its rays say; its points alone, which say
nothing of rays without a return; its observed voxels alone, each a point at its centre. Differences
are paired by map, with 95 % intervals over worlds.
"""

import measuring
import numpy as np
from numpy.typing import NDArray

from scenegen.dataset.read import Dataset, Split
from scenegen.model.completion.completer import Completer
from scenegen.model.evaluation.metrics import METRICS, measure_whole
from scenegen.model.evaluation.statistics import figure, interval
from scenegen.model.inputs import PointScan, centres, channels
from scenegen.truth import distance_field

SHOWN = ("iou", "recall", "near_rmse")


def main() -> None:
    """Print a line for each dataset and way."""
    parser = measuring.options(__doc__)
    parser.add_argument("datasets", nargs="+")
    parser.add_argument("--weights", default="columns")
    parser.add_argument("--maps", type=int, default=60)
    options = measuring.parse(parser, maps=2)
    completer = Completer.from_pretrained(options.weights)
    columns = [list(METRICS).index(name) for name in SHOWN]
    for folder in options.datasets:
        split = Dataset(folder).split("test")
        numbers = range(min(options.maps, len(split)))
        found = np.array([_measured(completer, split, n) for n in numbers])[:, :, columns]
        worlds = [split[n].world for n in numbers]
        for way, name in enumerate(("sample", "points alone", "voxels alone")):
            cells = [f"{what} {found[:, way, m].mean():.3f}" for m, what in enumerate(SHOWN)]
            if way:
                lost = [
                    figure(found[:, way, m] - found[:, 0, m], worlds) for m in range(len(SHOWN))
                ]
                cells += [f"({one['mean']:+.3f} {interval(one, '+.3f')})" for one in lost]
            print(f"{split.dataset.manifest.kind:10} {name:13}", *cells)


def _measured(completer: Completer, split: Split, number: int) -> list[NDArray[np.float64]]:
    """The metrics of one map, (3, metrics)."""
    sample, grid = split[number], split.dataset.grid
    scan = PointScan(points=sample.points(), position=sample.position, grid=grid)
    ways = [
        channels(completer.inputs, sample, grid, split.dataset.lidar),
        channels(completer.inputs, scan, grid),
        channels(completer.inputs, centres(sample.observed, grid), grid),
    ]
    truth = distance_field(sample.occupancy, grid)
    return [measure_whole(completer(maps), sample.occupancy, truth, grid) for maps in ways]


if __name__ == "__main__":
    main()
