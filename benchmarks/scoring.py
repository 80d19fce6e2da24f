"""What benchmarks of networks share: datasets drawn for them, figures, and pages of tables."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from scenegen.dataset.build import build, plan_dataset
from scenegen.dataset.read import Dataset
from scenegen.files import Json
from scenegen.model.evaluation.methods import Method
from scenegen.model.evaluation.metrics import PLAN_METRICS
from scenegen.model.evaluation.run import DatasetResult
from scenegen.model.evaluation.statistics import brief, figure, head, line
from scenegen.recipe import Recipe
from scenegen.source import DrawnWorlds, Source, read_scenes

RESULTS = Path(__file__).parents[1] / "docs" / "results"
MARK = "<!-- tables -->"
"""In a page: below it, all is written anew."""


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


def write_tables(page: Path, lines: Iterable[str]) -> None:
    """Write the tables of a page anew; what stands above them stays."""
    said = page.read_text().partition(MARK)[0] if page.is_file() else f"# {page.stem}\n\n"
    page.write_text(f"{said}{MARK}\n" + "\n".join(lines) + "\n")


def titled(title: str, methods: Sequence[Method]) -> list[str]:
    """A heading, and the head of a table with a column for each method."""
    return ["", f"## {title}", "", *head([one.name for one in methods])]


def tables(
    titles: Mapping[str, str],
    results: Mapping[str, DatasetResult],
    methods: Sequence[Method],
    *,
    of_maps: bool = False,
    form: str = ".3f",
) -> list[str]:
    """A table for each metric of `titles`: a line for each of `results`, with what each method
    reached, and intervals over worlds, or over maps where each is of a flight of its own; a dash
    for a method that was not measured."""
    lines = []
    for metric, title in titles.items():
        planned = metric in PLAN_METRICS
        scale: Any = "outcome" if planned else "amount"
        lines += titled(title, methods)
        for name, result in results.items():
            groups: Any = result.worlds_of(metric)
            if of_maps:
                groups = maps_of(result) if planned else range(len(result.worlds))
            found = (result.methods.get(method.name) for method in methods)
            cells = [
                "–" if one is None else brief(figure(one.values(metric), groups, scale), form)
                for one in found
            ]
            lines.append(line(name, cells))
    return lines


def maps_of(result: DatasetResult, place: str = "") -> list[str]:
    """The map that each trial is in, told from those of other places."""
    return [f"{place} {map_}" for map_, _ in result.trial_places]


class Ahead:
    """By how much planning succeeds oftener than with the method `base`, trial by trial."""

    def __init__(self, base: str):
        self._base, self.groups = base, list[str]()
        self._gains: dict[str, list[float]] = {}

    def add(self, result: DatasetResult, groups: Iterable[str]) -> None:
        """Add the trials of a dataset, with the group of each, over which intervals are."""
        self.groups += groups
        base = result.methods[self._base].values("success")
        for name, method in result.methods.items():
            gains = (method.values("success") - base).tolist()
            self._gains.setdefault(name, []).extend(gains)

    def figures(self, scale: Any = "amount") -> dict[str, Json]:
        """The mean difference of every method."""
        return {name: figure(one, self.groups, scale) for name, one in self._gains.items()}
