"""Draw worlds that look the same through one scan, for docs/results/ceiling.md.

python docs/same_scan.py ROOT  # docs/pictures/ceiling.png, from the worlds of benchmarks/ceiling.py

The first three maps of those that are scored, from above: what the scan made known (grey:
nothing), the truth, three of the worlds, their mean, and what `anywhere` predicts.
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS.parent / "benchmarks"))

import ceiling  # noqa: E402

from lidarsim.grid import Floats  # noqa: E402
from scenegen import Dataset, Sample  # noqa: E402
from scenegen.model.bench.methods import rows_of  # noqa: E402

TITLES = ("seen", "truth", "worlds that look the same", "", "", "their mean", "`anywhere`")
NUMBERS = 1, 3, 5
UNKNOWN = 0.4


def seen_from_above(sample: Sample) -> Floats:
    """1 where a column has a return, 0 where a ray crossed it, else `UNKNOWN`, (X, Y)."""
    free, observed = sample.free.any(axis=2), sample.observed.any(axis=2)
    return np.where(observed, 1.0, np.where(free, 0.0, UNKNOWN))


def main() -> None:
    """Draw the picture."""
    given = ceiling.Options(root=Path(sys.argv[1]))
    split = Dataset(given.root / "data").split("test")
    (network,) = rows_of((), ("anywhere",))
    figure = Figure(figsize=(1.5 * len(TITLES), 1.5 * len(NUMBERS)), layout="constrained")
    for row, number in zip(figure.subplots(len(NUMBERS), len(TITLES)), NUMBERS, strict=True):
        sample, sections = split[number], ceiling.sections_of(given, number)
        layers = ceiling.solid_layers(sample.origin)
        predicted = ceiling.chance_of(network.completion(sample, split))[..., layers].mean(axis=2)
        drawn = sections[[0, len(sections) // 2, -1]]
        panels = seen_from_above(sample), ceiling.section_of(sample), *drawn, sections.mean(axis=0)
        for axes, panel, title in zip(row, (*panels, predicted), TITLES, strict=True):
            axes.imshow(panel.T, cmap="Greys", vmin=0, vmax=1, origin="lower")
            axes.set_axis_off()
            if number == NUMBERS[0]:
                axes.set_title(title, fontsize="small")
    figure.savefig(DOCS / "pictures" / "ceiling.png", dpi=90)


if __name__ == "__main__":
    main()
