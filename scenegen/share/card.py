"""The dataset card, `README.md`: front matter that the Hub reads, and what a person wants to
know."""

import json
from collections.abc import Mapping
from typing import Any

from scenegen.display.inspect import LABELS
from scenegen.share.publication import LOCK, PAPER, Publication
from scenegen.share.regenerate import ORIGINAL, source_file

SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))
"""Samples below which the Hub's size category is this."""
TAGS = (
    "scene-completion",
    "3d",
    "occupancy",
    "distance-field",
    "lidar",
    "voxels",
    "robotics",
    "synthetic",
    "hdf5",
)
MOST_NAMED = 50
"""Classes that a card names."""


def card(it: Publication) -> str:
    """The whole card."""
    parts = [
        _front_matter(it),
        f"# {it.name}",
        f"{it.sentence}. Made by scenegen, seed {it.manifest.seed}.",
    ]
    parts += [
        _pictures(it),
        _fields(it),
        _loading(it),
        _statistics(it),
        _making(it),
        _limits(it),
        _citing(it),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _front_matter(it: Publication) -> str:
    samples = it.statistics["samples"]
    size = next((name for most, name in SIZES if samples < most), "1M<n<10M")
    lines = ["---", f"pretty_name: {json.dumps(it.name)}", f"license: {it.licence.hub}"]
    lines += ["task_categories:", "- robotics", "tags:", *(f"- {tag}" for tag in TAGS)]
    lines += [
        "size_categories:",
        f"- {size}",
        "configs:",
        "- config_name: default",
        "  data_files:",
    ]
    for split in it.splits:
        lines += [f"  - split: {split}", f'    path: "{split}-*.h5"']
    return "\n".join([*lines, "---"])


def _pictures(it: Publication) -> str:
    if not it.pictures:
        return ""
    shown = "\n\n".join(f"![{caption}]({name})" for name, caption in it.pictures)
    return (
        f"{shown}\n\nFrom left to right: what the scan observed, what is there (both coloured by "
        f"height), and how far "
        "the nearest occupied voxel is, in the level just below the sensor, from dark (0 m) to "
        "light "
        f"({it.manifest.grid.truncation_m:g} m). The dot is the sensor. Shown are "
        f"{', '.join(caption for _, caption in it.pictures)}." + _page(it)
    )


def _page(it: Publication) -> str:
    if not it.page:
        return ""
    return f"\n\nMore samples in three dimensions: download [{it.page}]({it.page}), and open it in a browser."


def _fields(it: Publication) -> str:
    rows = ["| field | type, shape of a sample | unit | meaning |", "|---|---|---|---|"]
    for name, field in it.fields.items():
        shape = " × ".join(map(str, field["shape"]))
        kind = f"{field['dtype']} ({shape})" if shape else field["dtype"]
        rows.append(f"| `{name}` | {kind} | {field['unit'] or '–'} | {field['meaning']} |")
    grid = it.manifest.grid
    absent = [f"`{name}`" for name in ("free", "tudf") if name not in it.fields]
    derived = (
        f" {' and '.join(absent)} follow from these; scenegen derives them on reading."
        if absent
        else ""
    )
    surfaces = (
        " Truth is of surfaces: a voxel that lies wholly inside one solid is not occupied."
        if grid.hollow
        else ""
    )
    table = "\n".join(rows)
    if it.manifest.labels is not None:
        classes = it.manifest.labels["classes"]
        more = f" and {len(classes) - MOST_NAMED} more" if len(classes) > MOST_NAMED else ""
        table += f"\n\nClasses, from 0: {', '.join(map(json.dumps, classes[:MOST_NAMED]))}{more}."
    return f"""## What is in it

{table}

Grids are indexed x, y, z; z points up; voxels are {grid.voxel_m:g} m wide and the sensor sits at the map's centre.
A voxel that is neither observed nor free is unknown.{surfaces} Distances end at {grid.truncation_m:g} m. The LiDAR has
{it.manifest.lidar}.{derived}

Every `SPLIT-NNNNN.h5` is a plain HDF5 file with samples along the first dimension; the `.worlds.zip` beside it holds
the MuJoCo model (MJCF) of each of its worlds. No world is in two splits. `dataset.json` lists these files with their
SHA-256, and every parameter; `sha256sum -c SHA256SUMS` checks them all."""


def _loading(it: Publication) -> str:
    first = it.manifest.shards[0].file
    return f"""## Load it

With nothing but h5py and numpy, after
`hf download {it.repository} --repo-type dataset --revision {it.tag} --local-dir {it.name}`:

```python
import h5py
import numpy as np

with h5py.File("{it.name}/{first}") as shard:
    observed = shard["observed"][0]  # input: what the scan saw
    occupancy = shard["occupancy"][0]  # truth
    origin = shard["origin"][0]
centres = origin + (np.argwhere(occupancy) + 0.5) * {it.manifest.grid.voxel_m!r}  # metres, in the world
print(f"{{observed.sum()}} of {{len(centres)}} occupied voxels were observed")
```

With Hugging Face `datasets`, as a stream or whole:

```python
from datasets import load_dataset

samples = load_dataset("{it.repository}", revision="{it.tag}", split="{it.splits[0]}", streaming=True)
```

With scenegen, which checks every file against its SHA-256:

```python
import scenegen

samples = scenegen.load("hf://{it.repository}@{it.tag}", split="{it.splits[0]}")
samples[0].tudf, samples.describe()["tudf"]
```"""


def _statistics(it: Publication) -> str:
    splits: Mapping[str, Any] = {name: it.statistics["splits"][name] for name in it.splits}
    rows = [f"| | {' | '.join(splits)} |", "|---" * (len(splits) + 1) + "|"]
    for key in ("samples", "worlds"):
        rows.append(f"| {key} | {' | '.join(str(split[key]) for split in splits.values())} |")
    for key, (label, unit, factor) in LABELS.items():
        cells = []
        for split in splits.values():
            value = split["statistics"][key]
            absent = value["mean"] is None
            cells.append(
                "–" if absent else f"{value['mean'] * factor:.2f} ± {value['std'] * factor:.2f}"
            )
        rows.append(f"| {label}, {unit} | {' | '.join(cells)} |")
    measured = ", ".join(f"{split['sampled']} of {name}" for name, split in splits.items())
    rejected = it.manifest.rejected
    dropped = "; ".join(
        f"{what}: {', '.join(f'{reason} {count}' for reason, count in counts.items())}"
        for what, counts in rejected.items()
        if counts
    )
    told = (
        "" if it.manifest.rescan is not None else f" Rejected while drawing: {dropped or 'none'}."
    )
    return (
        "## Statistics\n\n"
        + "\n".join(rows)
        + f"\n\nMean ± standard deviation over evenly spread samples ({measured}). "
        f"The whole takes {it.statistics['bytes'] / 1e6:.0f} MB, "
        f"{it.statistics['bytes_per_sample'] / 1e3:.0f} KB a "
        f"sample.{told}"
    )


def _making(it: Publication) -> str:
    versions = ", ".join(f"{name} {number}" for name, number in it.manifest.software.items())
    file, _ = source_file(it.manifest)
    follows = f"every sample follows from the seed and `{file}`"
    stands = ""
    if it.manifest.rescan is not None:
        follows = (
            f"the worlds and poses of another dataset were scanned again by the sensor in `{file}`"
        )
        stands = f"\n\n`{ORIGINAL}` stands for that dataset, whose digest is `{it.manifest.rescan['digest']}`."
    elif it.manifest.kind == "scene":
        stands = "\n\n`SCENES` stands for the MJCF files whose names and digests `dataset.json` lists under `recipe`."
    checks = "\n".join(f"- {name}: {detail}" for name, detail in it.checks)
    return f"""## Make it again

Nothing here was measured or labelled by hand: {follows}.

```
{it.command}
```

The versions that made it: {versions}. `{LOCK}` pins them, and all that they need in turn. On the same platform the
result is the same to the bit, with the digest

```
{it.manifest.digest}
```
{stands}
Before publication `scenegen verify` found:

{checks}"""


def _limits(it: Publication) -> str:
    faults = "no noise, no motion during a turn, no return lost within range"
    if it.manifest.noise is not None:
        faults = f"its noise is simulated, `{it.manifest.noise['stages']}`"
    return f"""## What to mind

- The worlds are synthetic and simple, and so is the scan: {faults}.
  What is learned here need not hold outside; measure it there.
- Truth ends at the map's faces: distances know nothing of solids outside.
- A free voxel may be occupied in the truth: rays graze.
- Evenly drawn worlds are not a sample of any real place, and hold neither people nor personal data.

Licence: [{it.licence.name}]({it.licence.url})."""


def _citing(it: Publication) -> str:
    return f"""## Cite

The task, the sensor and the maps follow this paper; the data are not its authors', and were made independently of them.

> {PAPER}

```bibtex
@misc{{{it.name.replace("-", "_")},
  title = {{{it.name}: {it.statistics["samples"]} samples for 3D scene completion}},
  author = {{{{{it.repository.partition("/")[0]}}}}},
  year = {{{it.date[:4]}}},
  howpublished = {{\\url{{{it.url}}}}},
  note = {{revision {it.tag}, digest {it.manifest.digest}}}
}}
```"""
