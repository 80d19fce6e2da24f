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
from scoring import drawn

from scenegen.model.completion.unlearned import Returns
from scenegen.model.config import BenchConfig, PlanConfig
from scenegen.model.evaluation.methods import Completed, Truth
from scenegen.model.evaluation.paper import PLANNING
from scenegen.model.evaluation.run import bench
from scenegen.model.evaluation.statistics import with_std
from scenegen.recipe import make_recipe
from scenegen.recipes import kind_names
from scenegen.run.workers import Local

PAPERS = ("length", "min_clearance", "avg_clearance", "success")
"""The paper's figures."""
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
        cells = [row[key] for key in PAPERS]
        print(f"{'paper, ' + name:44}" + "".join(f"{with_std(*cell):>14}" for cell in cells))
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
        dataset = drawn(Path(folder), recipe, options.samples, split="val", seed=1)
        occupied = [float(sample.occupancy.mean()) for sample in dataset.split("val")[::5]]
        config = BenchConfig(split="val", trials=options.trials, plan=plan)
        found = bench(dataset, [Truth(), Completed(Returns())], config, execute=Local("", 2))
    print(f"{label}")
    excluded = found.excluded.total() / (len(found.trial_worlds) + found.excluded.total())
    for name, result in found.methods.items():
        columns = [
            *(_of(result.values(name)) for name in PAPERS[:3]),
            f"{result.values('success').mean():.3f}",
            f"{excluded:.3f}",
            _of(occupied),
            str(sum(dataset.manifest.rejected["worlds"].values())),
        ]
        print(f"{'    ' + name:44}" + "".join(f"{column:>14}" for column in columns), flush=True)


def _of(values: Any) -> str:
    return with_std(float(np.nanmean(values)), float(np.nanstd(values)))


if __name__ == "__main__":
    main()
