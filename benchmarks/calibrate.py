"""Worlds against the paper: what depends on no network, for one variant of a recipe after the
other.

    python benchmarks/calibrate.py pillar --vary world.density=[0.03,0.10] --vary
    flight.altitude_m=[3,5]
    python benchmarks/calibrate.py geometric --faces box --safety 1.25

Draws validation worlds, plans on the truth's map and on the returns', and prints a row to set
beside the paper's Table II. Test worlds are never looked at. A `--vary` may have several values,
separated by `;`: all combinations are run.
"""

import argparse
import itertools
import tempfile
import tomllib
from pathlib import Path
from typing import Any

import measuring
import numpy as np

from scenegen.dataset.build import build, plan_dataset
from scenegen.dataset.read import Dataset
from scenegen.model.completion.unlearned import Returns
from scenegen.model.evaluation.config import BenchConfig, PlanConfig
from scenegen.model.evaluation.methods import Completed, Truth
from scenegen.model.evaluation.paper import PLANNING
from scenegen.model.evaluation.run import bench
from scenegen.recipe import make_recipe
from scenegen.recipes import kind_names
from scenegen.source import DrawnWorlds

COLUMNS = (
    "length",
    "min clear",
    "avg clear",
    "success",
    "excluded",
    "occupied",
    "rejected",
)


def main() -> None:
    """Parse, and print a table."""
    parser = measuring.options(__doc__)
    parser.add_argument("kind", choices=kind_names())
    parser.add_argument(
        "--vary",
        action="append",
        default=[],
        help="table.parameter=VALUE;VALUE…, values as in TOML",
    )
    parser.add_argument("--samples", type=int, default=150, help="validation maps, five a world")
    parser.add_argument("--trials", type=int, default=600)
    parser.add_argument("--faces", default=PlanConfig().goal_faces)
    parser.add_argument("--safety", type=float, default=PlanConfig().safety_m)
    options = measuring.parse(parser, samples=5, trials=10)
    print(f"{'':44}" + "".join(f"{name:>14}" for name in COLUMNS))
    for name, row in PLANNING[options.kind].items():
        cells = [row[key] for key in ("length", "min_clearance", "avg_clearance", "success")]
        print(f"{'paper, ' + name:44}" + "".join(f"{_spread(*cell):>14}" for cell in cells))
    for chosen in itertools.product(*(_values(item) for item in options.vary)):
        tables: dict[str, dict[str, Any]] = {}
        for table, parameter, value in chosen:
            tables.setdefault(table, {})[parameter] = value
        label = " ".join(f"{parameter}={value}" for _, parameter, value in chosen) or "preset"
        _measure(options, tables, label)


def _values(item: str) -> list[tuple[str, str, Any]]:
    """The alternatives of one --vary: (table, parameter, value)."""
    name, _, values = item.partition("=")
    table, _, parameter = name.partition(".")
    return [(table, parameter, tomllib.loads(f"x = {value}")["x"]) for value in values.split(";")]


def _measure(options: argparse.Namespace, tables: dict[str, Any], label: str) -> None:
    recipe = make_recipe(options.kind, tables, where="--vary")
    plan = PlanConfig(goal_faces=options.faces, safety_m=options.safety)
    with tempfile.TemporaryDirectory() as folder:
        counts = {"train": 0, "val": options.samples, "test": 0}
        summary = build(
            plan_dataset(
                Path(folder), recipe, DrawnWorlds(recipe), seed=1, counts=counts, shard_samples=50
            ),
            workers=2,
        )
        dataset = Dataset(folder)
        occupied = [float(sample.occupancy.mean()) for sample in dataset.split("val")[::5]]
        config = BenchConfig(split="val", trials=options.trials, plan=plan)
        found = bench(dataset, [Truth(), Completed(Returns())], config, workers=2)
    print(f"{label}")
    drawn = len(found.trial_worlds) + found.excluded.total()
    for name, result in found.methods.items():
        trials = result.trials
        columns = [
            _of([trial.length_m for trial in trials]),
            _of([trial.min_clearance_m for trial in trials]),
            _of([trial.mean_clearance_m for trial in trials]),
            f"{np.mean([trial.success for trial in trials]):.3f}",
            f"{found.excluded.total() / drawn:.3f}",
            _of(occupied),
            str(sum(summary.rejected["worlds"].values())),
        ]
        print(f"{'    ' + name:44}" + "".join(f"{column:>14}" for column in columns), flush=True)


def _of(values: list[float]) -> str:
    return _spread(float(np.nanmean(values)), float(np.nanstd(values)))


def _spread(mean: float, std: float | None) -> str:
    return f"{mean:.3f}" if std is None else f"{mean:.3f}±{std:.3f}"


if __name__ == "__main__":
    main()
