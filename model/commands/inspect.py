"""`scenegen inspect`: what something is."""

import json
from pathlib import Path

import rich_click as click

from scenegen.cli.options import (
    columns_option,
    command,
    dataset_argument,
    json_option,
    open_dataset,
    workers_option,
)
from scenegen.cli.show import (
    Progress,
    note,
    per_split,
    plain,
    rejections,
    say,
    show_columns,
    show_table,
)
from scenegen.files import Json
from scenegen.paths import function_for, type_of
from scenegen.worlds.mapping import Mapper


@command("inspect data/pillar", "inspect scenes/forest.xml --json")
@dataset_argument
@click.option("--all", "every", is_flag=True, help="Measure all samples, not 200 of each split.")
@click.option(
    "--keep",
    is_flag=True,
    help="Measure all, and keep what was measured beside them, for inspect, take --where and "
    "publish.",
)
@click.option(
    "--details",
    is_flag=True,
    help="Also print the extremes of every measure, its mean for each kind, and the datasets that "
    "this one was made of.",
)
@columns_option
@workers_option
@json_option
def inspect(
    dataset: Path | str,
    every: bool,
    keep: bool,
    details: bool,
    columns: int | None,
    workers: int,
    as_json: bool,
) -> None:
    """Print what is in a dataset: counts, sizes, and statistics of scans and truth.

    A folder of datasets is listed; of a world (.xml), an OctoMap (.bt, .ot), a scan, a file of
    predictions (.h5; the first one of a folder's), or a run's folder, it says what it is.
    """
    from scenegen.display.inspect import MOST_MEASURED, misfits
    from scenegen.display.inspect import inspect as examine
    from scenegen.model.config import NetworkConfig

    name = type_of(dataset)
    if name not in (None, "dataset", "collection", "selection"):
        given = {"columns": columns} if name == "scan" else {}
        facts = function_for(dataset, "facts")(Path(dataset), **given)
        if as_json:
            print(json.dumps(facts))
        elif name == "datasets":
            _show_all(facts)
        else:
            show_table(plain(facts))
        return
    opened = open_dataset(dataset, shown=not as_json)
    with Progress("inspect", shown=(every or keep) and not as_json) as progress:
        found = examine(
            opened,
            most=None if every else MOST_MEASURED,
            keep=keep,
            workers=workers,
            on_start=progress.start,
            on_done=progress.count,
        )
    sensors = dict.fromkeys(sensing.lidar for sensing in opened.settings)
    warnings = [line for lidar in sensors for line in misfits(opened.grid, lidar)]
    try:
        NetworkConfig(height=opened.grid.shape[2]).check_map(opened.grid.shape)
    except ValueError as error:
        warnings.append(str(error))
    if as_json:
        print(json.dumps(found | {"warnings": warnings}))
        return
    _show(dataset, found, details=details)
    for line in warnings:
        note(f"note: {line}")


def _show_all(rows: list[Json]) -> None:
    """Prints a line for each dataset."""
    for row in rows:
        told = row.get("fault")
        if not told:
            digest = str(row["digest"])[:8] if row["complete"] else "incomplete"
            told = f"{row['kind']}: {per_split(row['samples'])}, {digest}"
        show_table({row["folder"]: told})


def _show(dataset: Path | str, summary: Json, *, details: bool) -> None:
    """Prints the summary of a dataset and its measures, with `details` in a table of each split."""
    size = f"{summary['bytes'] / 1e6:.1f} MB"
    if summary["samples"]:
        size += f", {summary['bytes_per_sample'] / 1e3:.1f} KB a sample"
    datasets = summary.get("datasets", (summary,))
    for about in datasets:
        grid = about["grid"]
        hollow = ", truth of surfaces" if grid["hollow"] else ""
        rows = {
            "dataset": about["name"],
            "kind": about["kind"],
            "seed": about["seed"],
            "complete": "yes" if about["complete"] else "no",
            "digest": about["digest"] or "none yet",
            "grid": f"{grid['shape']} voxels of {grid['voxel_m']} m{hollow}",
            "sensor": about["lidar"],
            "maps": str(Mapper(**about["mapping"])),
            **({"noise": about["noise"]} if about["noise"] else {}),
            "fields": ", ".join(about["fields"]),
            "rejected": rejections(about["rejected"]),
        }
        show_table(rows)
    listed = "none is listed before the run is complete"
    show_table({"samples": summary["samples"] or listed, "size": size})
    splits = summary["splits"]
    if not details:
        _show_means(splits)
    for name, split in splits.items() if details else ():
        _show_split(name, split)


def _show_means(splits: Json) -> None:
    """Prints the means of the measures in each split, and what they measure."""
    from scenegen.display.inspect import TITLES

    if not splits:
        return
    counts = ("samples", "worlds", "sampled")
    cells = {name: [str(split[name]) for split in splits.values()] for name in counts}
    cells["measured"] = cells.pop("sampled")
    meanings = {"measured": "of these samples; --all measures all"}
    for key, (title, unit) in TITLES.items():
        factor = 100 if unit == "%" else 1
        spreads = [split["statistics"][key] for split in splits.values()]
        cells[key] = [
            "–"
            if spread["mean"] is None
            else f"{factor * spread['mean']:.2f} ± {factor * spread['std']:.2f}"
            for spread in spreads
        ]
        meanings[key] = f"{title}, {unit}".removesuffix(", ")
    show_columns(cells, list(splits), "means ± standard deviations of samples", meanings)
    say("\n--details prints extremes, worlds and kinds")


def _show_split(name: str, split: Json) -> None:
    """Prints the statistics of a split, and the means of each of several kinds in it."""
    from scenegen.display.inspect import TITLES

    rows, worlds = {}, split.get("world_means")
    factors = {key: 100 if unit == "%" else 1 for key, (_, unit) in TITLES.items()}
    for key, statistics in split["statistics"].items():
        rows[key] = "–"
        if statistics["mean"] is not None:
            mean, std, low, high = (factors[key] * value for value in statistics.values())
            unit = TITLES[key][1]
            rows[key] = f"{mean:6.2f} ± {std:5.2f} {unit}   from {low:.2f} to {high:.2f}"
            if worlds:
                low, high = (factors[key] * worlds[key][end] for end in ("min", "max"))
                rows[key] += f", worlds from {low:.2f} to {high:.2f}"
    counts = f"{split['samples']} samples of {split['worlds']} worlds"
    show_table(rows, f"{name}: {counts} ({split['sampled']} measured)")
    if kinds := split.get("kinds"):
        cells = {"measured": [str(kind["sampled"]) for kind in kinds.values()]}
        for key, factor in factors.items():
            means = [kind["statistics"][key]["mean"] for kind in kinds.values()]
            cells[key] = ["–" if mean is None else f"{mean * factor:.3f}" for mean in means]
        show_columns(cells, list(kinds), f"{name}: means of each kind, shares in %")
