"""How networks do at home, and under conditions that the first of them never met.

    python benchmarks/anywhere.py --network anywhere --network columns    # docs/results/anywhere.md

Worlds are of the two kinds that `columns` learned from. The conditions: the sensor as it is; five
scans fused; flights close to the ground; a spinning sensor with noise that loses a twentieth of its
returns; and the default sensor's points alone, which say nothing of rays without a return.
"""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import measuring

from scenegen.dataset.build import build, plan_dataset
from scenegen.dataset.read import Dataset, Split
from scenegen.model.completion.completer import Completer
from scenegen.model.completion.protocol import Prediction
from scenegen.model.completion.unlearned import Extrude
from scenegen.model.evaluation.config import BenchConfig, PlanConfig
from scenegen.model.evaluation.methods import Completed, Method, Truth
from scenegen.model.evaluation.metrics import METRICS
from scenegen.model.evaluation.run import DatasetResult, bench
from scenegen.model.evaluation.statistics import figure, head, interval, line
from scenegen.model.inputs import PointScan, channels
from scenegen.recipe import make_recipe
from scenegen.sample import Sample
from scenegen.source import DrawnWorlds

PAGE = Path(__file__).parents[1] / "docs" / "results" / "anywhere.md"
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
    tables: dict[str, list[str]] = {"IoU": [], "Near-RMSE, m": [], "Success": []}
    plain: list[Method] = [Completed(Extrude()), *networks, Truth()]
    kinds = KINDS[:1] if given.smoke else KINDS
    for kind, condition, methods, dataset in measured(kinds, given.maps, networks, plain):
        config = BenchConfig(trials=given.trials, plan=PlanConfig(planner="careful"))
        result = bench(dataset, methods, config, workers=1)
        for title, lines in tables.items():
            lines.append(line(f"`{kind}`, {condition}", cells(result, title, plain)))
        print(tables["IoU"][-1], flush=True)
    lines = []
    for title, rows in tables.items():
        lines += ["", f"## {title}", "", *head([one.name for one in plain]), *rows]
    if not given.smoke:
        said = given.page.read_text().partition("<!-- tables -->")[0]
        given.page.write_text(f"{said}<!-- tables -->\n" + "\n".join(lines) + "\n")


def measured(
    kinds: Sequence[str], maps: int, networks: list[Completer], plain: list[Method]
) -> Iterator[tuple[str, str, list[Method], Dataset]]:
    """Every kind and condition with the methods that are measured, and its dataset."""
    for kind in kinds:
        for number, (condition, tables) in enumerate(CONDITIONS.items()):
            recipe = make_recipe(kind, tables)
            recipe = replace(recipe, flight=replace(recipe.flight, viewpoints=2))
            with tempfile.TemporaryDirectory() as folder:
                path, counts = Path(folder, "data"), {"train": 0, "val": 0, "test": maps}
                build(plan_dataset(path, recipe, DrawnWorlds(recipe), seed=1, counts=counts))
                yield kind, condition, plain, Dataset(path)
                if number == 0:
                    yield kind, POINTS, [PointsAlone(one) for one in networks], Dataset(path)


def cells(result: DatasetResult, title: str, methods: list[Method]) -> Iterator[str]:
    """A row of the table `title`; empty cells for methods that were not measured."""
    metric = {"IoU": "iou", "Near-RMSE, m": "near_rmse"}.get(title)
    for method in methods:
        found = result.methods.get(method.name)
        if found is None:
            yield "–"
        elif metric is None:
            success = [trial.success for trial in found.trials]
            yield shown(figure(success, result.trial_worlds, "outcome"))
        else:
            values = found.reconstruction[:, 0, list(METRICS).index(metric)]
            yield shown(figure(values, result.worlds))


def shown(value: dict[str, Any]) -> str:
    """A mean with its interval."""
    return f"{value['mean']:.3f} {interval(value, '.3f')}"


if __name__ == "__main__":
    main()
