"""Every kind's preset: how fast it is, how many draws are rejected, and what its maps hold.

    python benchmarks/kinds.py                 # the table of docs/worlds.md
    python benchmarks/kinds.py --worlds 2 maze

Processor time of one core. The pace is a multiple of that of `geometric` in the same run.
"""

import argparse
import time

import numpy as np

from scenegen.draw import draw_unit
from scenegen.recipe import preset
from scenegen.recipes import kind_names
from scenegen.sample import Sample
from scenegen.source import DrawnWorlds
from scenegen.truth.difficulty import Difficulty, difficulty
from scenegen.worlds.world import solid


def measure(kind: str, worlds: int) -> dict[str, float]:
    """The figures of a preset over so many flights."""
    recipe = preset(kind)
    source = DrawnWorlds(recipe)
    draw_unit(source, recipe, seed=0, split="val", unit=0)  # compiles kernels
    begin, rejected, solids = time.process_time(), 0, []
    occupied, unknown = [], []
    samples: list[Sample] = []
    for number in range(worlds):
        unit = draw_unit(source, recipe, seed=1, split="val", unit=number)
        rejected += sum(unit.rejected.worlds.values())
        solids.append(solid(unit.world, "drawn").model.ngeom)
        occupied += [sample.occupancy.mean() for sample in unit.samples]
        unknown += [1 - (sample.observed | sample.free).mean() for sample in unit.samples]
        samples += unit.samples
    taken = time.process_time() - begin
    hard = [difficulty(one.occupancy, one.tudf, recipe.grid.voxel_m) for one in samples]
    return {
        **dict(zip(Difficulty._fields, np.nanmean(hard, axis=0).tolist(), strict=True)),
        "samples a second": len(occupied) / taken,
        "rejected": rejected / (rejected + worlds),
        "solids": float(np.mean(solids)),
        "occupied": float(np.mean(occupied)),
        "unknown": float(np.mean(unknown)),
    }


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("kinds", nargs="*", choices=[[], *kind_names()], default=[])
    parser.add_argument("--worlds", type=int, default=100)
    parser.add_argument("--smoke", action="store_true", help="one world of two kinds")
    given = parser.parse_args()
    names = ["maze"] if given.smoke else given.kinds or kind_names()
    worlds = 1 if given.smoke else given.worlds
    found = {kind: measure(kind, worlds) for kind in dict.fromkeys(("geometric", *names))}
    base = found["geometric"]["samples a second"]
    print("| kind | solids | occupied · unknown | rejected · pace |\n|---|---|---|---|")
    for kind, row in found.items():
        print(
            f"| `{kind}` | {row['solids']:.0f} | {row['occupied']:.1%} · {row['unknown']:.0%} | "
            f"{row['rejected']:.0%} · {row['samples a second'] / base:.2f} |"
        )
    print(
        "\n| kind | clearance · visibility · passage, m | dispersion · tortuosity · traversability "
        "· gap | obstruction · occlusion · turning |\n|---|---|---|---|"
    )
    for kind, row in found.items():
        cells = (
            "{clearance_m:.2f} · {visibility_m:.2f} · {passage_m:.2f} | {dispersion:.2f} · "
            "{tortuosity:.3f} · {traversability:.2f} · {gap:.2f} | "
            "{obstruction:.2f} · {occlusion:.2f} · {turning:.3f}"
        )
        print(f"| `{kind}` | {cells.format(**row)} |")


if __name__ == "__main__":
    main()
