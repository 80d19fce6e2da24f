"""`scenegen inspect` and `view`: what something is, and samples in three dimensions, with what was
predicted of them."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from scenegen.base.files import Json, write_result
from scenegen.base.paths import function_for, type_of
from scenegen.cli import stops
from scenegen.cli.bench import chosen, shown_options
from scenegen.cli.options import (
    columns_option,
    command,
    dataset_argument,
    flags_given,
    group,
    index_option,
    json_option,
    open_dataset,
    quiet_option,
    split_option,
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
from scenegen.cli.types import OutputFile
from scenegen.worlds.mapping import Mapper

if TYPE_CHECKING:
    from scenegen.dataset.read import AnyDataset
    from scenegen.view.look import Guesses


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
    from scenegen.model.config import NetworkConfig
    from scenegen.view.inspect import MAX_MEASURED, misfits
    from scenegen.view.inspect import inspect as examine

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
            most=None if every else MAX_MEASURED,
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
    from scenegen.view.inspect import TITLES

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
    from scenegen.view.inspect import TITLES

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


MAX_SHOWN = 200
"""The most samples in a file."""


@command(
    "view data/pillar",
    "view data/pillar --split test --weights columns --weights proposed",
    "view data/pillar --index 3 --index 7 --html samples.html",
)
@dataset_argument
@split_option("train", help="The split to show samples of.")
@click.option(
    "-o",
    "--html",
    "--output",
    "--out",
    "out",
    type=OutputFile(),
    help="Write one file that shows samples without a network.  [default: serve all of them]",
)
@index_option
@click.option(
    "--n",
    "count",
    type=click.IntRange(1, MAX_SHOWN),
    default=24,
    help="In a file: how many samples, evenly spread, where no --index is given.",
)
@click.option(
    "--host",
    default="127.0.0.1",
    help="Address to serve on; with 0.0.0.0 all who reach this machine can look.",
)
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=8000,
    help="0 for any.",
)
@quiet_option
@shown_options
@group("What is shown", "split index n html")
@group("In a browser", "host port")
def view(
    dataset: Path | str,
    split: str,
    indices: tuple[int, ...],
    count: int,
    out: Path | None,
    host: str,
    port: int,
    quiet: bool,
    **shown: Any,
) -> None:
    """Show a dataset in a browser, from this machine; or, with --html, write one file that shows
    some of it, or the completion of a scan (.h5)."""
    if out is not None and (odd := flags_given(("host", "port"))):
        raise click.UsageError(f"{odd[0]}: is for what is served; leave out --html")
    if out is None and len(indices) > 1:
        raise click.UsageError(
            "--index: give one to begin with, or --html for a file of several samples"
        )
    name = type_of(dataset)
    if out is not None and name == "predictions":
        from scenegen.view.page import page

        looks = function_for(dataset, "shows")(Path(dataset))
        write_result(out, page(looks, title=str(dataset)).encode())
        if not quiet:
            say(f"{out}: open it in a browser")
        return
    source = open_dataset(dataset, shown=not quiet)
    opened = list(source.datasets) if len(source.datasets) > 1 else [source]
    if out is None and len(opened) > 1 and shown["predictions"] is not None:
        raise click.UsageError("--predictions: is of one dataset; name that one")
    guesses, methods = chosen(source if out is not None else opened[0], split, **shown)
    if out is not None:
        write_page(source, split, indices, count, out, quiet, guesses)
        return
    from scenegen.view.look import incomplete
    from scenegen.view.page import Live

    samples, index = len(opened[0].split(split)), indices[0] if indices else 0
    if index >= max(samples, 1):
        raise click.UsageError(f"--index {index}: its {split} split has {samples} samples")
    for each in opened:
        for line in incomplete(each, split):
            note(f"{each.name}: {line}")
    server = Live(
        opened, split=split, index=index, host=host, port=port, guesses=guesses, methods=methods
    )
    with server, stops.noted() as stopped:
        folders = ", ".join(each.name for each in opened)
        say(f"{server.address}  shows {folders}; Ctrl-C ends it")
        if server.on_loopback:
            bound = server.server_address[1]
            say(
                f"from another machine: ssh -L {bound}:127.0.0.1:{bound} to this one, then the "
                "same address there"
            )
        while not stopped():
            server.handle_request()


def write_page(
    found: "AnyDataset",
    split: str,
    indices: tuple[int, ...],
    count: int,
    out: Path,
    quiet: bool,
    guesses: "Guesses | None",
) -> None:
    """Write a page that holds what it shows: samples of a split by `indices`, else `count` of them,
    evenly spread."""
    from scenegen.view.look import evenly, looks, title_of
    from scenegen.view.page import check_grid, page

    check_grid(found.grid)
    shown, notes = looks(found, split, indices or evenly(len(found.split(split)), count), guesses)
    title = f"{title_of(found)}, {split}"
    content = page(shown, title=title, notes=notes)
    write_result(out, content.encode())
    for line in notes:
        note(line)
    if not quiet:
        say(f"{out}: {len(shown)} samples, {len(content) / 1e6:.1f} MB; open it in a browser")
