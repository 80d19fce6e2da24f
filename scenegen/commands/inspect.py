"""`scenegen inspect`: what is in a dataset."""

import json
from pathlib import Path
from typing import Any

import rich_click as click

from scenegen.mapping import Mapper
from scenegen.terminal.options import dataset_argument, json_option
from scenegen.terminal.show import rejections, show_table


@click.command()
@dataset_argument
@json_option
def inspect(dataset: Path | str, as_json: bool) -> None:
    """Print what is in a dataset: counts, sizes, and statistics of scans and truth."""
    from scenegen.dataset.locate import locate
    from scenegen.inspect import inspect as examine

    found = examine(locate(dataset, shown=not as_json))
    if as_json:
        print(json.dumps(found))
    else:
        _show(dataset, found)


def _show(dataset: Path | str, found: dict[str, Any]) -> None:
    show_table(
        {
            "dataset": dataset,
            "kind": found["kind"],
            "seed": found["seed"],
            "complete": "yes" if found["complete"] else "no",
            "digest": found["digest"],
            "grid": f"{found['grid']['shape']} voxels of {found['grid']['voxel']} m",
            "maps": Mapper(**(found["mapping"] or {})),
            "fields": ", ".join(found["fields"]),
            "samples": found["samples"],
            "size": f"{found['bytes'] / 1e6:.1f} MB, {found['bytes_per_sample'] / 1e3:.1f} KB a sample",
            "rejected": rejections(found["rejected"]),
        },
    )
    units = {"range_m": ("mean range", "m", 1), "tudf_m": ("mean distance", "m", 1)}
    for name, split in found["splits"].items():
        rows = {}
        for key, value in split["statistics"].items():
            label, unit, factor = units.get(key, (key, "%", 100))
            mean, std, low, high = (None if value[name] is None else value[name] * factor for name in value)
            rows[label] = "–" if mean is None else f"{mean:6.2f} ± {std:5.2f} {unit}   from {low:.2f} to {high:.2f}"
        title = f"{name}: {split['samples']} samples of {split['worlds']} worlds ({split['sampled']} measured)"
        show_table(rows, title)
