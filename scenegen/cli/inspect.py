"""`scenegen inspect` summarizes a dataset, a world or a file; `view` shows samples in three
dimensions, with predictions."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from scenegen.base.files import Json, write_result
from scenegen.base.paths import DATA, function_for, type_of
from scenegen.cli import stops
from scenegen.cli.bench import chosen, prediction_options
from scenegen.cli.options import (
    columns_option,
    command,
    dataset_argument,
    flags_given,
    group,
    index_option,
    json_option,
    log_options,
    open_dataset,
    quiet_option,
    split_option,
    workers_option,
)
from scenegen.cli.show import (
    ProgressBar,
    echo,
    info,
    per_split,
    plain,
    rejections,
    show_columns,
    show_table,
)
from scenegen.cli.types import OutputFile
from scenegen.worlds.mapping import Mapper

if TYPE_CHECKING:
    from scenegen.dataset.read import AnyDataset
    from scenegen.view.look import Guesses
    from scenegen.view.page import PageServer


MAX_ON_PAGE = 200
"""Maximum samples in a page."""


@command("inspect data/pillar", "inspect scenes/forest.xml --json")
@dataset_argument
@click.option(
    "--all", "measure_all", is_flag=True, help="Measure all samples, not 200 of each split."
)
@click.option(
    "--keep",
    is_flag=True,
    help="Measure all samples, and store the measures beside them, for inspect, take --where and "
    "publish.",
)
@click.option(
    "--details",
    is_flag=True,
    help="Also print extremes of every measure, and its mean for each kind.",
)
@columns_option
@workers_option
@json_option
def inspect(
    dataset: Path | str,
    measure_all: bool,
    keep: bool,
    details: bool,
    columns: int | None,
    workers: int,
    as_json: bool,
) -> None:
    """Print counts and sizes of a dataset, and statistics of its scans and its truth.

    Or list a folder of datasets; or print facts of a world (.xml), an OctoMap (.bt, .ot), a scan, a
    file of predictions (.h5; of a folder, the first one), or the folder of a training run.

    \f
    Args:
        dataset: What to inspect.
        measure_all: Measure all samples.
        keep: Store the measures beside the dataset.
        details: Print extremes and means of kinds.
        columns: Columns of a scan without a header.
        workers: Number of processes.
        as_json: Print JSON.
    """
    from scenegen.model.config import NetworkConfig
    from scenegen.view.inspect import MAX_MEASURED, misfits
    from scenegen.view.inspect import inspect as examine

    name = type_of(dataset)
    # None is a path of no type: opening it below says what is wrong with it
    if name not in (None, "dataset", "collection", "selection"):
        options = {"columns": columns} if name == "scan" else {}
        facts = function_for(dataset, "facts")(Path(dataset), **options)
        if as_json:
            print(json.dumps(facts))
        elif name == "datasets":
            _show_all(facts)
        else:
            show_table(plain(facts))
        return
    opened = open_dataset(dataset, show_progress=not as_json)
    with ProgressBar("inspect", visible=(measure_all or keep) and not as_json) as progress:
        summary = examine(
            opened,
            most=None if measure_all else MAX_MEASURED,
            keep=keep,
            workers=workers,
            on_start=progress.start,
            on_done=progress.count,
        )
    # datasets of a collection may share a sensor: one warning is enough
    sensors = dict.fromkeys(sensing.lidar for sensing in opened.settings)
    warnings = [line for lidar in sensors for line in misfits(opened.grid, lidar)]
    # networks halve maps three times: warn now of a grid that training would refuse
    try:
        NetworkConfig(height=opened.grid.shape[2]).check_map(opened.grid.shape)
    except ValueError as error:
        warnings.append(str(error))
    if as_json:
        print(json.dumps(summary | {"warnings": warnings}))
        return
    _show(dataset, summary, details=details)
    for line in warnings:
        info(f"note: {line}")


def _show_all(rows: list[Json]) -> None:
    """Print a line for each dataset."""
    for row in rows:
        text = row.get("fault")
        if not text:
            digest = str(row["digest"])[:8] if row["complete"] else "incomplete"
            text = f"{row['kind']}: {per_split(row['samples'])}, {digest}"
        show_table({row["folder"]: text})


def _show(dataset: Path | str, summary: Json, *, details: bool) -> None:
    """Print the summary of a dataset and its measures, with `details` in a table for each split."""
    size = f"{summary['bytes'] / 1e6:.1f} MB"
    if summary["samples"]:
        size += f", {summary['bytes_per_sample'] / 1e3:.1f} KB a sample"
    datasets = summary.get("datasets", (summary,))
    for facts in datasets:
        grid = facts["grid"]
        hollow = ", truth of surfaces" if grid["hollow"] else ""
        rows = {
            "dataset": facts["name"],
            "kind": facts["kind"],
            "seed": facts["seed"],
            "complete": "yes" if facts["complete"] else "no",
            "digest": facts["digest"] or "none yet",
            "grid": f"{grid['shape']} voxels of {grid['voxel_m']} m{hollow}",
            "sensor": facts["lidar"],
            "maps": str(Mapper(**facts["mapping"])),
            **({"noise": facts["noise"]} if facts["noise"] else {}),
            "fields": ", ".join(facts["fields"]),
            "rejected": rejections(facts["rejected"]),
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
    """Print the means of measures in each split, and the names of measures."""
    from scenegen.view.inspect import titles

    if not splits:
        return
    counts = ("samples", "worlds", "sampled")
    cells = {name: [str(split[name]) for split in splits.values()] for name in counts}
    cells["measured"] = cells.pop("sampled")
    meanings = {"measured": "of these samples; --all measures all"}
    for key, (title, unit) in titles(splits).items():
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
    echo("\n--details prints extremes, worlds and kinds")


def _show_split(name: str, split: Json) -> None:
    """Print the statistics of a split, and the means of each of several kinds."""
    from scenegen.view.inspect import titles

    rows, worlds, measures = {}, split.get("world_means"), titles({name: split})
    factors = {key: 100 if unit == "%" else 1 for key, (_, unit) in measures.items()}
    for key, factor in factors.items():
        mean, std, low, high = (factor * value for value in split["statistics"][key].values())
        rows[key] = f"{mean:6.2f} ± {std:5.2f} {measures[key][1]}   from {low:.2f} to {high:.2f}"
        if worlds:
            low, high = (factor * worlds[key][end] for end in ("min", "max"))
            rows[key] += f", worlds from {low:.2f} to {high:.2f}"
    counts = f"{split['samples']} samples of {split['worlds']} worlds"
    show_table(rows, f"{name}: {counts} ({split['sampled']} measured)")
    if kinds := split.get("kinds"):
        cells = {"measured": [str(kind["sampled"]) for kind in kinds.values()]}
        for key, factor in factors.items():
            means = [kind["statistics"][key]["mean"] for kind in kinds.values()]
            cells[key] = ["–" if mean is None else f"{mean * factor:.3f}" for mean in means]
        show_columns(cells, list(kinds), f"{name}: means of each kind, shares in %")


@command(
    "view data/pillar",
    "view data/pillar --split test --weights columns --weights proposed",
    "view data/pillar --index 3 --index 7 --html samples.html",
    "view flights.json --index 3",
)
@dataset_argument
@split_option("train", help="Split of the samples.")
@click.option(
    "-o",
    "--html",
    "--output",
    "--out",
    "out",
    type=OutputFile(".html"),
    help="Write one page, which needs no server.  [default: serve all samples]",
)
@index_option
@click.option(
    "--n",
    "count",
    type=click.IntRange(1, MAX_ON_PAGE),
    default=24,
    help="In a page: number of samples, evenly spread, unless --index is given.",
)
@click.option(
    "--host",
    default="127.0.0.1",
    help="Address to serve on; with 0.0.0.0, everyone who reaches this machine can look.",
)
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=8000,
    help="Port to serve on; 0 for any free one.",
)
@quiet_option
@prediction_options
@columns_option
@log_options
@group("What is shown", "split index n html")
@group("Scans and logs", "columns poses poses-of topic fixed-frame")
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
    columns: int | None,
    log_reading: Json,
    **predicting: Any,
) -> None:
    """Show a dataset in a browser, served from this machine. With --html, write a page with some
    samples. Or show a scan, a folder of scans, a log, a map, a world (.xml), a mesh, a floor plan,
    completions of scans (.h5), flights (.json), or the folder of a training run.

    \f
    Raises:
        UsageError: Options contradict each other, or there is no such sample.
        ScenegenError: The dataset cannot be read, or the address cannot be served on.
    """
    if out is not None and (flags := flags_given(("host", "port"))):
        raise click.UsageError(f"{flags[0]}: is for what is served; leave out --html")
    if out is None and len(indices) > 1:
        raise click.UsageError(
            "--index: give one to begin with, or --html for a file of several samples"
        )
    name, reading = type_of(dataset), log_reading | {"columns": columns}
    is_data = name in (None, *DATA)
    options: Json = {
        "scan": {"columns": columns},
        "scans": reading,
        "log": reading,
        "flights": {"number": (*indices, 0)[0]},
    }.get(name or "", {})
    others = reading.keys() - options.keys()
    if not is_data:
        others |= {"split", "count", *predicting, *["indices"] * (name != "flights")}
    if flags := flags_given(others):
        raise click.UsageError(f"{flags[0]}: is not for the type {name or 'dataset'}; leave it out")
    if not is_data:
        _show_path(dataset, options, out, host, port, quiet)
        return
    source = open_dataset(dataset, show_progress=not quiet)
    opened = list(source.datasets) if len(source.datasets) > 1 else [source]
    # predictions name samples by their number in one dataset
    if out is None and len(opened) > 1 and predicting["predictions"] is not None:
        raise click.UsageError("--predictions: is of one dataset; name that one")
    guesses, methods = chosen(source if out is not None else opened[0], split, **predicting)
    if out is not None:
        write_page(source, split, indices, count, out, quiet, guesses)
        return
    from scenegen.view.look import incomplete
    from scenegen.view.page import Live

    samples, index = len(opened[0].split(split)), indices[0] if indices else 0
    # an empty split is served, too: 0 is also the default
    if index >= max(samples, 1):
        raise click.UsageError(f"--index {index}: its {split} split has {samples} samples")
    for part in opened:
        for line in incomplete(part, split):
            info(f"{part.name}: {line}")
    server = Live(
        opened, split=split, index=index, host=host, port=port, guesses=guesses, methods=methods
    )
    _serve(server, ", ".join(part.name for part in opened))


def _show_path(
    path: Path | str, options: Json, out: Path | None, host: str, port: int, quiet: bool
) -> None:
    """Show anything but a dataset: write its page, or serve it.

    Raises:
        ScenegenError: The path cannot be shown, or the address cannot be served on.
    """
    from scenegen.view.notebook import page_of
    from scenegen.view.page import PageServer

    page = page_of(str(path), **options)
    # several samples may have the same note
    for line in dict.fromkeys(line for look in page.looks for line in look.missing):
        info(line)
    if out is None:
        _serve(PageServer(page.html, host=host, port=port), str(path))
        return
    write_result(out, page.html.encode())
    if not quiet:
        echo(f"{out}: {len(page.html) / 1e6:.1f} MB; open it in a browser")


def _serve(server: "PageServer", names: str) -> None:
    """Serve a page until the user stops it; `names` says what it shows."""
    # noted: Ctrl-C ends the loop between two requests, and the server closes
    with server, stops.noted() as stopped:
        echo(f"{server.address}  shows {names}; Ctrl-C ends it")
        if server.on_loopback:
            bound = server.server_address[1]
            echo(
                f"from another machine: ssh -L {bound}:127.0.0.1:{bound} to this one, then the "
                "same address there"
            )
        while not stopped():
            server.handle_request()


def write_page(
    dataset: "AnyDataset",
    split: str,
    indices: tuple[int, ...],
    count: int,
    out: Path,
    quiet: bool,
    guesses: "Guesses | None",
) -> None:
    """Write a page that holds its samples.

    Args:
        dataset: The dataset.
        split: Name of the split.
        indices: Samples in the split; empty: `count` of them, evenly spread.
        count: Number of samples without `indices`.
        out: File of the page.
        quiet: Print errors only.
        guesses: Function that predicts samples, or None.

    Raises:
        DatasetError: No sample can be read, or their grid is too large for a browser.
    """
    from scenegen.view.look import evenly, looks, title_of
    from scenegen.view.page import check_grid, page

    check_grid(dataset.grid)  # before any sample is read and predicted
    samples, notes = looks(
        dataset, split, indices or evenly(len(dataset.split(split)), count), guesses
    )
    title = f"{title_of(dataset)}, {split}"
    content = page(samples, title=title, notes=notes)
    write_result(out, content.encode())
    for line in notes:
        info(line)
    if not quiet:
        echo(f"{out}: {len(samples)} samples, {len(content) / 1e6:.1f} MB; open it in a browser")
