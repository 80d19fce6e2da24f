"""How networks do at home, and under conditions that the first of them never met.

    python benchmarks/anywhere.py --network anywhere --network columns    # docs/results/anywhere.md

Worlds are of the two kinds that `columns` learned from. The conditions: the sensor as it is; five
scans fused; flights close to the ground; a spinning sensor with noise that loses a twentieth of its
returns; and the default sensor's points alone, which say nothing of rays without a return.
"""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import measuring
from scoring import RESULTS, drawn, tables, write_tables

from scenegen.dataset.read import Dataset, Split
from scenegen.model.completion.completer import Completer
from scenegen.model.completion.protocol import Prediction
from scenegen.model.completion.unlearned import Extrude
from scenegen.model.config import BenchConfig, PlanConfig
from scenegen.model.evaluation.methods import Completed, Method, Truth
from scenegen.model.evaluation.run import bench
from scenegen.model.inputs import PointScan, channels
from scenegen.recipe import make_recipe
from scenegen.sample import Sample

PAGE = RESULTS / "anywhere.md"
TABLES = {"iou": "IoU", "near_rmse": "Near-RMSE, m", "success": "Success"}
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
POINTS = "points alone"


@dataclass(frozen=True)
class PointsAlone:
    """A network that is shown the points of a sample, and nothing of rays without a return."""

    network: Any
    learned: bool = True

    @property
    def name(self) -> str:
        """The network's."""
        return str(self.network.name)

    def completion(self, sample: Sample, split: Split) -> Prediction:
        """See `Method.completion`."""
        grid = split.dataset.grid
        scan = PointScan(points=sample.points(), position=sample.position, grid=grid)
        said: Prediction = self.network(channels(self.network.inputs, scan, grid))
        return said


def main() -> None:
    """Measure every condition, and write the page's tables."""
    parser = measuring.options(__doc__)
    parser.add_argument("--network", action="append", help="a bundled one's name, or a run")
    parser.add_argument("--maps", type=int, default=60, help="test maps a kind and condition")
    parser.add_argument("--trials", type=int, default=240, help="planning trials of these")
    parser.add_argument("--page", type=Path, default=PAGE)
    given = measuring.parse(parser, maps=2, trials=2, network=["columns"])
    names = given.network or ("anywhere", "columns", "proposed")
    networks = [Completer.from_pretrained(name, threads=1) for name in names]
    plain: list[Method] = [Completed(Extrude()), *networks, Truth()]
    kinds = KINDS[:1] if given.smoke else KINDS
    config = BenchConfig(trials=given.trials, plan=PlanConfig(planner="careful"))
    results = {
        f"`{kind}`, {condition}": bench(dataset, methods, config)
        for kind, condition, methods, dataset in measured(kinds, given.maps, networks, plain)
    }
    lines = tables(TABLES, results, plain)
    print("\n".join(lines))
    if not given.smoke:
        write_tables(given.page, lines)


def measured(
    kinds: Sequence[str], maps: int, networks: list[Completer], plain: list[Method]
) -> Iterator[tuple[str, str, list[Method], Dataset]]:
    """Every kind and condition with the methods that are measured, and its dataset."""
    for kind in kinds:
        for number, (condition, changed) in enumerate(CONDITIONS.items()):
            with tempfile.TemporaryDirectory() as folder:
                recipe = make_recipe(kind, changed)
                dataset = drawn(Path(folder, "data"), recipe, maps, seed=1, viewpoints=2)
                yield kind, condition, plain, dataset
                if number == 0:
                    yield kind, POINTS, [PointsAlone(one) for one in networks], dataset


if __name__ == "__main__":
    main()
