"""What `scenegen inspect` does; the command itself stands where scans, predictions and runs are
known."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rich_click as click

from scenegen.cli.options import dataset_argument, json_option, workers_option
from scenegen.cli.show import flat, per_split, rejections, show_table
from scenegen.cli.types import OutputFile
from scenegen.worlds.mapping import Mapper


def inspect_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """The options of `show`."""
    page = click.option(
        "--html", "out", type=OutputFile(), help="Also write a page with histograms and pictures."
    )
    every = click.option(
        "--all", "every", is_flag=True, help="Measure all samples, not 200 of each split."
    )
    return dataset_argument(page(every(workers_option(json_option(function)))))


def show(
    dataset: Path | str,
    out: Path | None,
    every: bool,
    workers: int,
    as_json: bool,
    others: Callable[[Path], dict[str, Any] | None],
    misfit: Callable[[Any], list[str]],
) -> None:
    """Print what is in a dataset, a folder of them, a world (.xml), or in what `others` knows,
    which gives None for the rest. `misfit` tells of a grid what does not fit."""
    from scenegen.cli.progress import Progress, note
    from scenegen.dataset.locate import locate
    from scenegen.dataset.manifest import NAME
    from scenegen.dataset.read import Dataset
    from scenegen.display.inspect import MOST_MEASURED, inspect_all, inspect_world, misfits
    from scenegen.display.inspect import inspect as examine

    path = Path(dataset)
    several = path.is_dir() and not (path / NAME).exists() and any(path.glob(f"*/{NAME}"))
    facts = inspect_world(path) if path.suffix == ".xml" else None if several else others(path)
    if out is not None and (several or facts is not None):
        raise click.UsageError("--html: is for one dataset")
    if several:
        _show_all(inspect_all(path), as_json)
    elif facts is not None:
        if as_json:
            print(json.dumps(facts))
        else:
            show_table({name: _plain(value) for name, value in flat(facts).items()})
    else:
        folder = locate(dataset, shown=not as_json)
        with Progress("inspect", shown=every and not as_json) as progress:
            found = examine(
                folder,
                most=None if every else MOST_MEASURED,
                values=out is not None,
                workers=workers,
                on_start=progress.start,
                on_done=progress.count,
            )
        opened = Dataset(folder, partial=True)
        mind = [*misfits(opened.grid, opened.lidar), *misfit(opened.grid)]
        if out is not None:
            _write_page(opened, found, mind, out)
            for split in found["splits"].values():
                del split["values"]
        if as_json:
            print(json.dumps(found | {"warnings": mind}))
        else:
            _show(dataset, found)
            for line in mind:
                note(f"note: {line}")


def _write_page(dataset: Any, found: dict[str, Any], mind: list[str], page: Path) -> None:
    from scenegen.display.statistics import statistics_page
    from scenegen.files import write_result

    content = statistics_page(dataset, found, mind)
    write_result(page, content.encode())


def _plain(value: Any) -> Any:
    """A value for people."""
    if isinstance(value, float):
        return f"{value:.4g}"
    return (
        ", ".join(str(_plain(one)) for one in value) or "none" if isinstance(value, list) else value
    )


def _said(source: dict[str, Any]) -> str:
    """A dataset that samples were taken from."""
    how = f", {' or '.join(ways)}" if (ways := [way for way in source["taken"] if way]) else ""
    return f"{source['kind']}, seed {source['seed']}, digest {source['digest'][:8]}{how}"


def _show_all(rows: list[dict[str, Any]], as_json: bool) -> None:
    if as_json:
        print(json.dumps(rows))
        return
    for row in rows:
        told = row.get("fault") or (
            f"{row['kind']}: {per_split(row['samples'])}, "
            f"{str(row['digest'])[:8] if row['complete'] else 'incomplete'}"
        )
        show_table({row["folder"]: told})


def _show(dataset: Path | str, found: dict[str, Any]) -> None:
    from scenegen.dataset.manifest import SEVERAL

    show_table(
        {
            "dataset": dataset,
            "kind": found["kind"],
            "seed": SEVERAL if found["seed"] is None else found["seed"],
            **{f"from {n}": _said(source) for n, source in enumerate(found.get("sources", ()))},
            "complete": "yes" if found["complete"] else "no",
            "digest": found["digest"] or "none yet",
            "grid": f"{found['grid']['shape']} voxels of {found['grid']['voxel']} m"
            + (", truth of surfaces" if found["grid"].get("hollow") else ""),
            "maps": Mapper(**(found["mapping"] or {})),
            "fields": ", ".join(found["fields"]),
            "samples": found["samples"],
            "size": f"{found['bytes'] / 1e6:.1f} MB, {found['bytes_per_sample'] / 1e3:.1f} KB a "
            f"sample",
            "rejected": rejections(found["rejected"]),
        },
    )
    units = {"range_m": ("mean range", "m", 1), "tudf_m": ("mean distance", "m", 1)}
    for name, split in found["splits"].items():
        rows = {}
        for key, value in split["statistics"].items():
            label, unit, factor = units.get(key, (key, "%", 100))
            mean, std, low, high = (
                None if value[name] is None else value[name] * factor for name in value
            )
            rows[label] = (
                "–"
                if mean is None
                else f"{mean:6.2f} ± {std:5.2f} {unit}   from {low:.2f} to {high:.2f}"
            )
        title = f"{name}: {split['samples']} samples of {split['worlds']} worlds ({split['sampled']} measured)"
        show_table(rows, title)
