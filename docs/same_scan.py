"""Draw worlds that look the same through one scan, for docs/results/ceiling.md.

python docs/same_scan.py PILLARS MAZES  # docs/pictures/ceiling.png

PILLARS and MAZES are the folders of benchmarks/ceiling.py. Of the first two maps of each that are
scored, the layer of the sensor: what the scan made known (grey: nothing), the truth, three of the
worlds, their mean, and what `anywhere` predicts.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS.parent / "benchmarks"))

import ceiling  # noqa: E402

from scenegen import Dataset  # noqa: E402
from scenegen.model.bench.methods import rows_of  # noqa: E402

TITLES = ("seen", "truth", "worlds that look the same", "", "", "their mean", "`anywhere`")
NUMBERS = 1, 3
UNKNOWN = 0.4


def main() -> None:
    """Draw the picture."""
    roots = dict(zip(ceiling.SAMPLERS, map(Path, sys.argv[1:]), strict=True))
    (network,) = rows_of((), ("anywhere",))
    maps = [(kind, number) for kind in roots for number in NUMBERS]
    figure = Figure(figsize=(1.5 * len(TITLES), 1.5 * len(maps)), layout="constrained")
    for row, (kind, number) in zip(figure.subplots(len(maps), len(TITLES)), maps, strict=True):
        options: Any = {"root": roots[kind], "kind": kind}
        given = ceiling.Options(**options)
        split = Dataset(given.root / "data").split("test")
        sample, layer = split[number], ceiling.GRID.shape[2] // 2
        worlds = ceiling.worlds_of(given, number, sample)[..., layer]
        seen = np.where(sample.observed, 1.0, np.where(sample.free, 0.0, UNKNOWN))
        predicted = ceiling.chance_of(network.completion(sample, split))
        drawn = worlds[[0, len(worlds) // 2, -1]]
        first, true, last = (one[..., layer] for one in (seen, sample.occupancy, predicted))
        panels = first, true, *drawn, worlds.mean(axis=0), last
        for axes, panel, title in zip(row, panels, TITLES, strict=True):
            axes.imshow(panel.T, cmap="Greys", vmin=0, vmax=1, origin="lower")
            axes.set_axis_off()
            if (kind, number) == maps[0]:
                axes.set_title(title, fontsize="small")
    figure.savefig(DOCS / "pictures" / "ceiling.png", dpi=90)


if __name__ == "__main__":
    main()
