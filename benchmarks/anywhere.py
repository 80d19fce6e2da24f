"""How networks do at home, and under conditions that the first of them never met.

    python benchmarks/anywhere.py --network anywhere columns    # docs/results/networks.md

Worlds are of the two kinds that `columns` learned from. The conditions: the sensor as it is; five
scans fused; flights close to the ground; a spinning sensor with noise that loses a twentieth of its
returns; and the default sensor's points alone, which say nothing of rays without a return.
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import measuring
from real import LevelScan
from scoring import CAREFUL, Options, Results, drawn, measured, publish, tables

from scenegen import Prediction, Sample
from scenegen.dataset.read import Split
from scenegen.model.bench.methods import Truth, rows_of
from scenegen.worlds.recipe import make_recipe

TABLES = {"iou": "## IoU", "near_rmse": "## Near-RMSE, m", "success": "## Success"}
KINDS = ("geometric", "pillar")
CONDITIONS: dict[str, dict[str, Any]] = {
    "the default sensor": {},
    "five scans": {"mapping": {"scans": 5}},
    "flights at 0.4 to 1 m": {"flight": {"altitude_m": [0.4, 1.0]}},
    "OS1-64, its noise, a twentieth lost": {
        "lidar": {"sensor": "ouster-os1-64"},
        "noise": {"stages": "datasheet,dropout:0.05"},
    },
}


@dataclass
class PointsAlone:
    """A network that is shown the points of a sample, and nothing of rays without a return."""

    network: Any
    name: str
    learned: bool = True

    def completion(self, sample: Sample, split: Split) -> Prediction:
        """See `Method.completion`."""
        grid = split.dataset.grid
        scan = LevelScan(points=sample.points(), position=sample.position, grid=grid)
        said: Prediction = self.network.completion(scan, split)
        return said


def main() -> None:
    """Measure every condition, and write the tables."""
    given = measuring.parse(Options, maps=2, trials=2, network=["columns"])
    methods = [*rows_of(["extrude"], given.network), Truth()]
    alone = [PointsAlone(one, one.name) for one in methods[1:-1]]
    results: Results = {}
    for kind in KINDS[: 1 if given.smoke else None]:
        for condition, changed in CONDITIONS.items():
            with tempfile.TemporaryDirectory() as folder:
                recipe = make_recipe(kind, changed)
                half = given.maps // 2
                dataset = drawn(
                    Path(folder, "data"), recipe, given.maps, seed=1, viewpoints=2, val=half
                )
                shown = {condition: methods} | ({} if changed else {"points alone": alone})
                for what, rows in shown.items():
                    place = {f"`{kind}`, {what}": dataset}
                    results |= measured(place, rows, given.trials, CAREFUL)
    names = [one.name for one in methods]
    best = tables({"iou": "## IoU at the best threshold"}, results, names, region=-1)
    publish(given, tables(TABLES, results, names) + best)


if __name__ == "__main__":
    main()
