"""What benchmarks of networks share: options, datasets of places, the bench in each, and tables."""

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import measuring
import numpy as np

from scenegen.dataset.build import build, plan_dataset
from scenegen.dataset.read import Dataset
from scenegen.files import Json
from scenegen.model.completion.completer import Completer
from scenegen.model.config import BenchConfig, PlanConfig
from scenegen.model.evaluation.methods import Method
from scenegen.model.evaluation.metrics import PLAN_METRICS
from scenegen.model.evaluation.run import DatasetResult, bench
from scenegen.model.evaluation.statistics import brief, figure, head, line
from scenegen.recipe import Recipe
from scenegen.source import DrawnWorlds, Source, read_scenes

RESULTS = Path(__file__).parents[1] / "docs" / "results"
MARK = "<!-- tables -->"
"""In a page: below it, all is written anew."""
CAREFUL = PlanConfig(planner="careful")


def options(doc: str | None, page: str, *, maps: int, trials: int) -> argparse.ArgumentParser:
    """A parser for a benchmark that measures networks on `maps` of each place, and planning on
    them, and writes the `page` of docs/results."""
    parser = measuring.options(doc)
    parser.add_argument("--network", action="append", help="a bundled one's name, a file or a run")
    parser.add_argument("--maps", type=int, default=maps, help="test maps of each place, at most")
    parser.add_argument("--trials", type=int, default=trials, help="planning trials of each place")
    parser.add_argument("--page", type=Path, default=RESULTS / page)
    return parser


def networks(names: Iterable[str]) -> list[Completer]:
    """Networks by name, of one thread each."""
    return [Completer.from_pretrained(name, threads=1) for name in names]


def drawn(
    folder: Path,
    recipe: Recipe,
    maps: int,
    *,
    scenes: Path | None = None,
    split: str = "test",
    seed: int = 0,
    viewpoints: int | None = None,
) -> Dataset:
    """A dataset in `folder` of so many maps, all in one split: in drawn worlds, or in those of the
    files `scenes`; with so many `viewpoints` a flight, by default as the recipe says."""
    if viewpoints is not None:
        recipe = replace(recipe, flight=replace(recipe.flight, viewpoints=viewpoints))
    counts = {"train": 0, "val": 0, "test": 0} | {split: maps}
    source: Source = DrawnWorlds(recipe)
    if scenes is not None:
        source = read_scenes(scenes, counts, seed=seed)
        recipe = source.suited(recipe)
    build(plan_dataset(folder, recipe, source, seed=seed, counts=counts))
    return Dataset(folder)


def split_of(dataset: Dataset) -> Any:
    """The split that holds a dataset's maps: of a map of a real place, all is train."""
    return "test" if len(dataset.split("test")) else "train"


def measured(
    places: Mapping[str, Dataset], methods: Sequence[Method], trials: int, plan: PlanConfig
) -> dict[str, DatasetResult]:
    """What the bench finds in every place."""
    found = {}
    for name, dataset in places.items():
        config = BenchConfig(split=split_of(dataset), trials=trials, plan=plan)
        found[name] = bench(dataset, methods, config)
    return found


def publish(given: argparse.Namespace, lines: Sequence[str]) -> None:
    """Print the tables, and write them to the page; not where they mean nothing."""
    print("\n".join(lines))
    if not given.smoke:
        rewrite(given.page, lines)


def rewrite(page: Path, lines: Sequence[str]) -> None:
    """Write the tables of a page anew; what stands above them stays."""
    said = page.read_text().partition(MARK)[0] if page.is_file() else f"# {page.stem}\n\n"
    page.write_text(f"{said}{MARK}\n" + "\n".join(lines) + "\n")


def titled(title: str, names: Iterable[str]) -> list[str]:
    """A title, and the head of a table with a column for each name."""
    return ["", title, "", *head([*names])]


Groups = Callable[[DatasetResult, str], Any]
"""What intervals of a metric are over: a group for each map or trial of a result."""


def by_map(result: DatasetResult, metric: str) -> Any:
    """Intervals over maps, where each is of a flight of its own."""
    return maps_of(result) if metric in PLAN_METRICS else range(len(result.worlds))


def tables(
    titles: Mapping[str, str],
    results: Mapping[str, DatasetResult],
    names: Sequence[str],
    *,
    groups: Groups = DatasetResult.worlds_of,
    form: str = ".3f",
    region: int = 0,
) -> list[str]:
    """A table for each metric of `titles`: a line for each of `results`, with what the methods
    `names` reached in a region of the maps; a dash for a method that was not measured."""
    lines = []
    for metric, title in titles.items():
        scale: Any = "outcome" if metric in PLAN_METRICS else "amount"
        lines += titled(title, names)
        for place, result in results.items():
            found = (result.methods.get(name) for name in names)
            cells = [
                "–"
                if one is None
                else brief(figure(one.values(metric, region), groups(result, metric), scale), form)
                for one in found
            ]
            lines.append(line(place, cells))
    return lines


def maps_of(result: DatasetResult, place: str = "") -> list[str]:
    """The map that each trial is in, told from those of other places."""
    return [f"{place} {map_}" for map_, _ in result.trial_places]


def ahead(
    pairs: Iterable[tuple[DatasetResult, Sequence[str]]], base: str, scale: Any = "amount"
) -> dict[str, Json]:
    """By how much planning succeeds oftener than with the method `base`, trial by trial of several
    results together; each comes with the group of every trial, over which intervals are."""
    results, groups = zip(*pairs, strict=True)

    def figure_of(name: str) -> Json:
        gains = [
            one.methods[name].values("success") - one.methods[base].values("success")
            for one in results
        ]
        return figure(np.concatenate(gains), np.concatenate(groups), scale)

    return {name: figure_of(name) for name in results[0].methods}
