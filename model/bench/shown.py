"""Predictions of a sample and the bench's paths on them, for viewers; pictures of failed trials;
charts.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any

from lidarsim.grid import Field, Floats, Mask
from scenegen.base.errors import DatasetError
from scenegen.base.files import Json
from scenegen.dataset.read import Split
from scenegen.draw.sample import rng_of
from scenegen.model.bench.methods import Method, answers
from scenegen.model.bench.planner import Lattice
from scenegen.model.bench.report import CAUSES, tables
from scenegen.model.bench.run import (
    DatasetResult,
    measured_targets,
    planner_maps,
    scored_map,
    trials_of,
    true_maps,
)
from scenegen.model.bench.trials import judge, plan_trial
from scenegen.model.bench.visibility import Case
from scenegen.model.config import BenchConfig, PlanConfig
from scenegen.view.look import Guess, Route, look_into


def guesses(
    methods: Sequence[Method], config: BenchConfig, trial: int | None, split: Split, index: int
) -> list[Guess]:
    """Predict a sample by several methods, and plan on each prediction.

    Args:
        methods: The methods.
        config: Thresholds and planner.
        trial: Number of the bench's trial in this sample, whose goal paths lead to; None: no paths.
        split: The split.
        index: The sample's number in it.

    Returns:
        The predictions. They have no path if the sample has no such trial.

    Raises:
        DatasetError: A file of predictions lacks the sample.
    """
    case, goal = Case(split[index], index, split), None
    if trial is not None:
        # trials are drawn one after the other, so the first so many are those of the bench
        goals = trials_of(case, config.plan, trial + 1, rng_of(config.seed, index)).goals
        goal = goals[trial] if len(goals) > trial else None
    guessed = []
    for method in methods:
        try:
            (prediction,) = answers(method, case.sample, split, config.seed, index, draws=1)
        except KeyError:
            raise DatasetError(f"{method.name} does not predict it") from None
        at = config.thresholds
        occupied, tudf = prediction.occupied(at), prediction.distance(at, case.grid)
        maps = planner_maps(prediction, case, config)
        route = None if goal is None else route_to(goal, *maps, case, config.plan)
        targets = measured_targets([method], config, split, index)
        judged = scored_map(prediction, case, true_maps(case, targets), at)
        figures = {
            metric.label: f"{metric.of(judged):.3f}"
            for target in targets.values()
            for metric in target.metrics.values()
        }
        guess = Guess(name=method.name, occupied=occupied, tudf=tudf, route=route, figures=figures)
        guessed.append(dataclasses.replace(guess, chance=prediction.chance))
    return guessed


def route_to(
    goal: Floats, occupied: Mask, tudf: Field, risk: Field | None, case: Case, config: PlanConfig
) -> Route:
    """Plan a path on predicted maps as the bench does, and judge it in the truth.

    Args:
        goal: The goal (3,), map frame, metres.
        occupied: Predicted occupancy (*grid.shape).
        tudf: Predicted distances (*grid.shape), metres.
        risk: Risk of every voxel for the careful planner, or None.
        case: The sample.
        config: The planner.

    Returns:
        The route in the world's frame, with its outcome in words.
    """
    origin, grid = case.sample.origin, case.grid
    plan, refined = plan_trial(occupied, tudf, risk, goal, grid, config)
    measured = judge(plan, refined, *case.truth, grid)
    lattice = Lattice(grid, config.step_voxels)
    outcome = f"{measured.length_m:.1f} m, clearance {measured.min_clearance_m:.2f} m"
    if measured.cause is not None:
        outcome = CAUSES[measured.cause]
    return Route(
        start=origin + lattice.centres(lattice.start),
        goal=origin + goal,
        points=None if refined is None else origin + refined,
        told=outcome,
        hit=None if measured.hit is None else grid.centres(origin).reshape(-1, 3)[measured.hit],
    )


MAX_FAILURES = 3
WIDE = 900
"""Pixels of a picture."""


def failing(result: DatasetResult) -> tuple[str, list[int]]:
    """Select failures to draw.

    Args:
        result: All methods on a dataset.

    Returns:
        The learned method with the most successes, and trials of different worlds in which its path
        meets an obstacle; "" and [] if no method is learned.
    """
    learned = {name: method for name, method in result.methods.items() if method.learned}
    if not learned:
        return "", []
    name = max(learned, key=lambda learner: sum(trial.success for trial in learned[learner].trials))
    worlds: dict[int, int] = {}
    for n, trial in enumerate(learned[name].trials):
        if trial.hit is not None:
            # one a world: failures beside each other would look alike
            worlds.setdefault(int(result.trial_worlds[n]), n)
    return name, list(worlds.values())[:MAX_FAILURES]


def draw_failures(result: DatasetResult, methods: Sequence[Method]) -> list[tuple[str, bytes]]:
    """Draw trials in which the best learned method hits an obstacle.

    Args:
        result: All methods on a dataset.
        methods: The methods.

    Returns:
        Captions and WebP images.

    Raises:
        ImportError: matplotlib is not installed.
    """
    from scenegen.view.figures import draw_paths

    learned = [method for method in methods if method.learned]
    name, trials = failing(result)
    pictures = []
    for n in trials:
        # predicted again: a result keeps no maps
        index, turn = result.trial_places[n]
        of_trial = partial(guesses, learned, result.config, turn)
        look = look_into(result.dataset.split(result.config.split), index, of_trial)
        caption = f"{name} fails: {look.name}, goal {turn}"
        figure = draw_paths([dataclasses.replace(look, name=f"{look.name}, goal {turn}")], title="")
        pictures.append((caption, _webp(figure)))
    return pictures


CHARTS = ("iou", "near_rmse")
"""Metrics of maps that are drawn; of planning, the one that leads the table, and clearance."""


def draw_charts(report: Json, kind: str) -> list[tuple[str, bytes]]:
    """Draw charts: a dot with its interval for each method, a ring for each of the paper's.

    Args:
        report: From `build_report`.
        kind: The kind of worlds.

    Returns:
        Captions and WebP images.

    Raises:
        ImportError: matplotlib is not installed.
    """
    from matplotlib.figure import Figure

    from scenegen.view.panels import MAP, SOFT, plain

    charts = []
    for table, metrics, rows, reference in tables(report, kind):
        planned = next(iter(metrics)), "min_clearance"
        for name in CHARTS if table.startswith("reconstruction") else planned:
            dots = {method: row[name] for method, row in rows.items() if row[name]["n"]}
            papers = {
                f"{method} (paper)": row[name][0]
                for method, row in reference.items()
                if name in row
            }
            figure = Figure(figsize=(5.8, 0.6 + 0.26 * len([*dots, *papers])), layout="constrained")
            axes = figure.subplots()
            for method, metric in dots.items():
                ends = None if metric["low"] is None else [metric["low"], metric["high"]]
                # one world has no interval: a line of no length
                axes.plot(ends or [metric["mean"]] * 2, [plain(method)[:24]] * 2, "-", color=MAP)
                axes.plot(metric["mean"], plain(method)[:24], "o", color=MAP)
            axes.plot(list(papers.values()), list(papers), "o", color=SOFT, fillstyle="none")
            # in the order of the table, from top to bottom
            axes.invert_yaxis()
            axes.grid(axis="x")
            _, comma, best_draws = table.partition(", each")
            charts.append((metrics[name].label + comma + best_draws, _webp(figure)))
    return charts


def _webp(figure: Any) -> bytes:
    """A figure of matplotlib as a picture of the report."""
    from scenegen.view.panels import to_bytes

    figure.set_dpi(WIDE / figure.get_figwidth())
    return to_bytes(figure, ".webp")
