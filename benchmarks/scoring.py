"""What benchmarks of networks share: options, datasets of places, the bench in each, and tables."""

import csv
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import measuring
import numpy as np

from scenegen import Dataset, Recipe
from scenegen.dataset.build import build, plan_dataset
from scenegen.dataset.read import Split
from scenegen.draw.source import DrawnWorlds, Source, read_scenes
from scenegen.model.bench.methods import Method
from scenegen.model.bench.metrics import PLAN_METRICS
from scenegen.model.bench.run import DatasetResult, bench
from scenegen.model.bench.statistics import Scale, brief, summarise
from scenegen.model.config import BenchConfig, PlanConfig
from scenegen.model.tables import markdown

RESULTS = Path(__file__).parents[1] / "docs" / "results"
COLUMNS = "table", "row", "column", "value", "low", "high"
"""Of a file of figures, which stands beside the page that speaks of them."""
CAREFUL = PlanConfig(planner="careful")
Results = dict[str, DatasetResult]
"""By place."""


class Options(measuring.Options):
    """Of a benchmark that measures networks on maps of each place, and planning on them, and writes
    their tables."""

    network: Sequence[str] = ("anywhere", "columns", "proposed")
    """a bundled one's name, a file or a run"""
    maps: int = 60
    """test maps of each place, at most"""
    trials: int = 240
    """planning trials of each place"""
    figures: Path = RESULTS / f"{Path(sys.argv[0]).stem}.csv"
    """where the tables are written"""


def drawn(
    folder: Path,
    recipe: Recipe,
    maps: int,
    *,
    scenes: Path | None = None,
    split: str = "test",
    seed: int = 0,
    viewpoints: int | None = None,
    val: int = 0,
) -> Dataset:
    """A dataset in `folder` of so many maps in one split, and `val` for validation, on which the
    bench tunes thresholds: in drawn worlds, or in those of the files `scenes`; with so many
    `viewpoints` a flight, by default as the recipe says."""
    if viewpoints is not None:
        recipe = replace(recipe, flight=replace(recipe.flight, viewpoints=viewpoints))
    counts = {"train": 0, "val": val, "test": 0} | {split: maps}
    source: Source = DrawnWorlds(recipe)
    if scenes is not None:
        source, recipe = read_scenes(scenes, counts, seed=seed).suited(recipe)
    build(plan_dataset(folder, recipe, source, seed=seed, counts=counts))
    return Dataset(folder)


def maps_in(dataset: Dataset) -> Split:
    """A dataset's maps: of a map of a real place, all are in the train split."""
    return dataset.split("test" if len(dataset.split("test")) else "train")


def measured(
    places: Mapping[str, Dataset], methods: Sequence[Method], trials: int, plan: PlanConfig
) -> Results:
    """What the bench finds in every place."""
    found = {}
    for name, dataset in places.items():
        split: Any = maps_in(dataset).name
        config = BenchConfig(split=split, trials=trials, plan=plan)
        found[name] = bench(dataset, methods, config)
    return found


def publish(given: Any, lines: Sequence[str]) -> None:
    """Print the tables, and write them to the file beside the page; not where they mean nothing."""
    print("\n".join(lines))
    if not given.smoke:
        write_tables(given.figures, lines)


def write_tables(path: Path, lines: Sequence[str]) -> None:
    """Write tables as CSV, a line for each cell. Tables of other titles that the file has stay."""
    found = cells("\n".join(lines))
    titles = {cell["table"] for cell in found}
    if path.is_file():
        with path.open(newline="", encoding="utf-8") as file:
            found = [cell for cell in csv.DictReader(file) if cell["table"] not in titles] + found
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(found)


def cells(text: str) -> list[dict[str, str]]:
    """Every cell of the tables of a page, below the titles and the caption that lead to each; with
    the bounds of its interval, if the cell has one. Empty cells are left out."""
    found: list[dict[str, str]] = []
    titles: list[str] = []
    caption: list[str] = []
    heads: list[str] = []
    for line in text.replace("`", "").splitlines():
        if title := re.match(r"(#+) (.*)", line):
            titles, caption = [*titles[: len(title[1]) - 2], title[2]], []
        elif line.endswith(":"):
            caption = [line[:-1]]
        if not line.startswith("| ") or line.startswith("|--"):
            heads = heads if line.startswith("|--") else []
            continue
        row, *values = [cell.strip().strip("*") for cell in line.strip("|").split("|")]
        if not heads:
            heads = values
            continue
        for head, value in zip(heads, values, strict=False):
            if value and value != "–":
                bounds = re.fullmatch(r"(\S+(?: ± \S+)?) \[(\S+), (\S+)\]", value)
                split = bounds.groups() if bounds else (value, "", "")
                cell = (": ".join([*titles, *caption]), row, head, *split)
                found.append(dict(zip(COLUMNS, cell, strict=True)))
    return found


def titled(
    title: str,
    heads: Iterable[str],
    rows: Iterable[tuple[str, Iterable[str]]],
) -> list[str]:
    """A table below its title: a column for each of `heads`, and rows by name."""
    return ["", title, "", markdown([*heads], rows)]


def told(values: Any, groups: Any, form: str, scale: Scale = "amount") -> str:
    """The mean of values (N,) in this form, and its interval over their groups (N,)."""
    return brief(summarise(values, groups, scale), form)


def by_map(result: DatasetResult, metric: str) -> Any:
    """Intervals over maps, where each is of a flight of its own."""
    return maps_of(result) if metric in PLAN_METRICS else range(len(result.worlds))


def tables(
    titles: Mapping[str, str],
    results: Results,
    names: Sequence[str],
    *,
    groups: Callable[[DatasetResult, str], Any] = DatasetResult.worlds_of,
    form: str = ".3f",
    region: int = 0,
) -> list[str]:
    """A table for each metric of `titles`: a line for each of `results`, with what the methods
    `names` reached in a region of the maps; a dash for a method that was not measured. `groups`
    tells the group of each map or trial, which intervals are over."""

    def cell(name: str, metric: str, result: DatasetResult) -> str:
        if name not in result.methods:
            return "–"
        scale: Scale = "outcome" if metric in PLAN_METRICS else "amount"
        return told(
            result.methods[name].values(metric, region), groups(result, metric), form, scale
        )

    lines = []
    for metric, title in titles.items():
        rows = (
            (place, [cell(name, metric, result) for name in names])
            for place, result in results.items()
        )
        lines += titled(title, names, rows)
    return lines


def maps_of(result: DatasetResult, place: str = "") -> list[str]:
    """The map that each trial is in, told from those of other places."""
    return [f"{place} {map_}" for map_, _ in result.trial_places]


def ahead(
    pairs: Iterable[tuple[DatasetResult, Sequence[str]]], base: str, scale: Scale = "amount"
) -> dict[str, str]:
    """By how much planning with each method succeeds oftener than with the method `base`, trial by
    trial of several results together; each comes with the group of every trial, over which
    intervals are."""
    results, groups = zip(*pairs, strict=True)
    success = {
        name: np.concatenate([one.methods[name].values("success") for one in results])
        for name in results[0].methods
    }
    return {
        name: told(values - success[base], np.concatenate(groups), "+.3f", scale)
        for name, values in success.items()
    }
