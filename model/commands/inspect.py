"""`scenegen inspect`: what something is."""

import json
from collections.abc import Sequence
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
from scenegen.errors import plural
from scenegen.files import Json
from scenegen.worlds import MESHES, is_map
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
    from scenegen.dataset.manifest import NAME
    from scenegen.display.inspect import MOST_MEASURED, inspect_all, misfits
    from scenegen.display.inspect import inspect as examine
    from scenegen.model.config import NetworkConfig

    path = Path(dataset)
    if not (path / NAME).exists() and any(path.glob(f"*/{NAME}")):
        _show_all(inspect_all(path), as_json)
        return
    if facts := _facts(path, columns):
        print(json.dumps(facts)) if as_json else show_table(plain(facts))
        return
    opened = open_dataset(dataset, shown=not as_json)
    with Progress("inspect", shown=(every or keep) and not as_json) as progress:
        found = examine(
            opened.folder,
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


def _facts(path: Path, columns: int | None) -> Json | None:
    """What is to be said of a world, a scan, predictions, or a run; None for anything else."""
    from scenegen.clouds import READERS
    from scenegen.display.inspect import inspect_world, scan_facts
    from scenegen.model.config import PREDICTIONS

    if (path / PREDICTIONS).is_file():
        path = min(path.glob("*.h5"), default=path)
    if path.suffix in (".xml", *MESHES) or is_map(path):
        return inspect_world(path)
    if path.suffix.lower() in READERS:
        return scan_facts(path, columns)
    # what these import loads torch
    if path.suffix == ".h5":
        from scenegen.model.completion.stored import prediction_facts

        return prediction_facts(path)
    if (path / "metrics.csv").is_file():
        from scenegen.model.training.run_folder import run_facts

        return run_facts(path)
    return None


def _show_all(rows: list[Json], as_json: bool) -> None:
    """Prints a line for each dataset."""
    if as_json:
        print(json.dumps(rows))
        return
    for row in rows:
        told = row.get("fault")
        if not told:
            digest = str(row["digest"])[:8] if row["complete"] else "incomplete"
            told = f"{row['kind']}: {per_split(row['samples'])}, {digest}"
        show_table({row["folder"]: told})


def _show(dataset: Path | str, summary: Json, *, details: bool) -> None:
    """Prints the summary of a dataset and its measures, with `details` in a table of each split."""
    from scenegen.dataset.manifest import SEVERAL

    grid, sources = summary["grid"], summary.get("sources", ())
    hollow = ", truth of surfaces" if grid.get("hollow") else ""
    size = f"{summary['bytes'] / 1e6:.1f} MB"
    if summary["samples"]:
        size += f", {summary['bytes_per_sample'] / 1e3:.1f} KB a sample"
    maps = SEVERAL
    if not any("mapping" in source for source in sources):
        maps = str(Mapper(**(summary["mapping"] or {})))
    show_table(
        {
            "dataset": dataset,
            "kind": summary["kind"],
            "seed": SEVERAL if summary["seed"] is None else summary["seed"],
            **_sources(sources, details=details),
            "complete": "yes" if summary["complete"] else "no",
            "digest": summary["digest"] or "none yet",
            "grid": f"{grid['shape']} voxels of {grid['voxel']} m{hollow}",
            "maps": maps,
            "fields": ", ".join(summary["fields"]),
            "samples": summary["samples"] or "none is listed before the run is complete",
            "size": size,
            "rejected": rejections(summary["rejected"]),
        },
    )
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


def _sources(sources: Sequence[Json], *, details: bool) -> Json:
    """Lines on the datasets that samples were taken from."""
    if details:
        return {f"from {n}": _source(source) for n, source in enumerate(sources)}
    kinds = dict.fromkeys(source["kind"] for source in sources)
    return {"made of": f"{plural(len(sources), 'datasets')}: {', '.join(kinds)}"} if sources else {}


def _source(source: Json) -> str:
    """A dataset that samples were taken from, in words."""
    words = [f"{source['kind']}, seed {source['seed']}"]
    if source["digest"]:
        words.append(f"digest {source['digest'][:8]}")
    words += [source[name] for name in ("lidar", "mapping", "noise") if source.get(name)]
    words.append(per_split(source["samples"]))
    if choices := " or ".join(filter(None, source["taken"])):
        words.append(choices)
    return ", ".join(words)
