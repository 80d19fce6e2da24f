"""Every kind's preset: how fast it is, how many draws are rejected, and what its maps hold.

    python benchmarks/kinds.py                 # the table of docs/worlds.md
    python benchmarks/kinds.py --worlds 2 maze
    python benchmarks/kinds.py --difficulty easy medium hard

With `--difficulty` the kinds are as easy or hard as that says; with several, a table last compares
them.

Processor time of one core. The pace is a multiple of that of `geometric` in the same run.
"""

import itertools
import time
from collections import Counter
from collections.abc import Collection, Sequence
from typing import Literal

import measuring
import numpy as np
from tyro.conf import Positional

from scenegen import preset
from scenegen.draw.draw import draw_unit
from scenegen.draw.source import DrawnWorlds
from scenegen.truth.difficulty import difficulty
from scenegen.worlds.kinds import kind_names
from scenegen.worlds.world import solid

BASE = "geometric"
"""The pace is a multiple of that of this kind."""


class Options(measuring.Options):
    """What is measured."""

    kinds: Positional[Sequence[str]] = kind_names()
    worlds: int = 100
    difficulty: Sequence[Literal["easy", "medium", "hard"]] = ("medium",)
    """of the kinds; several to compare"""


def measure(kinds: Collection[str], worlds: int, level: str) -> dict[str, dict[str, float]]:
    """The figures of the kinds' presets of a difficulty over so many flights. Kinds take turns, so
    that whatever else the machine does slows all of them."""
    recipes = {kind: preset(kind, difficulty=level) for kind in kinds}
    found: dict[str, list[dict[str, float]]] = {kind: [] for kind in kinds}
    rejected, taken = Counter[str](), dict.fromkeys(kinds, 0.0)
    for number, kind in itertools.product(range(-1, worlds), kinds):
        recipe, begin = recipes[kind], time.process_time()
        unit = draw_unit(DrawnWorlds(recipe), recipe, seed=1, split="val", unit=max(number, 0))
        if number < 0:  # it compiled kernels
            continue
        taken[kind] += time.process_time() - begin
        rejected[kind] += sum(unit.rejected["worlds"].values())
        solids = solid(unit.world, "drawn").model.ngeom
        for one in unit.samples:
            hard = difficulty(one.occupancy, one.tudf, recipe.grid.voxel_m)
            unknown = 1 - (one.observed | one.free).mean()
            about = {"solids": solids, "occupied": one.occupancy.mean(), "unknown": unknown}
            found[kind].append(hard._asdict() | about)
    return {
        kind: {
            **{name: float(np.nanmean([row[name] for row in rows])) for name in rows[0]},
            "samples a second": len(rows) / taken[kind],
            "rejected": rejected[kind] / (rejected[kind] + worlds),
        }
        for kind, rows in found.items()
    }


def main() -> None:
    """Print the tables."""
    given = measuring.parse(Options, kinds=["maze"], worlds=1)
    names = dict.fromkeys((BASE, *given.kinds))
    graded = {level: measure(names, given.worlds, level) for level in given.difficulty}
    for level, found in graded.items():
        print(f"\n{level}\n")
        show(found)
    if len(graded) == 1:
        return
    print(f"\n{' · '.join(graded)}\n")
    print("| kind | visibility, m | passage, m | tortuosity · draws rejected |\n|---|---|---|---|")
    forms = "{visibility_m:.2f}", "{passage_m:.2f}", "{tortuosity:.3f}", "{rejected:.0%}"
    for kind in names:
        cells = (" · ".join(form.format(**it[kind]) for it in graded.values()) for form in forms)
        print("| `{}` | {} | {} | {}; {} |".format(kind, *cells))


def show(found: dict[str, dict[str, float]]) -> None:
    """Print two tables of a difficulty, a line a kind."""
    base = found[BASE]["samples a second"]
    print("| kind | solids | occupied · unknown | rejected · pace |\n|---|---|---|---|")
    for kind, row in found.items():
        print(
            f"| `{kind}` | {row['solids']:.0f} | {row['occupied']:.1%} · {row['unknown']:.0%} | "
            f"{row['rejected']:.0%} · {row['samples a second'] / base:.2f} |"
        )
    print(
        "\n| kind | clearance · visibility · passage, m | dispersion · tortuosity · traversability "
        "· gap |\n|---|---|---|"
    )
    for kind, row in found.items():
        cells = (
            "{clearance_m:.2f} · {visibility_m:.2f} · {passage_m:.2f} | {dispersion:.2f} · "
            "{tortuosity:.3f} · {traversability:.2f} · {gap:.2f}"
        )
        print(f"| `{kind}` | {cells.format(**row)} |")


if __name__ == "__main__":
    main()
