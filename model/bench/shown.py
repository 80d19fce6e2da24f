"""Predictions of a sample and the bench's paths on them, for viewers; pictures of failed trials;
a page of samples.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial

import numpy as np

from lidarsim.grid import Field, Floats, Mask
from scenegen.base.errors import DatasetError
from scenegen.base.files import Json
from scenegen.dataset.read import Split
from scenegen.draw.sample import rng_of
from scenegen.model.bench.methods import Method, answers
from scenegen.model.bench.metrics import METRICS
from scenegen.model.bench.planner import Lattice
from scenegen.model.bench.report import CAUSES, ranked
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
from scenegen.view.look import Guess, PlannedPath, look_into
from scenegen.view.page import page


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
) -> PlannedPath:
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
    return PlannedPath(
        start=origin + lattice.centres(lattice.start),
        goal=origin + goal,
        points=None if refined is None else origin + refined,
        told=outcome,
        hit=None if measured.hit is None else grid.centres(origin).reshape(-1, 3)[measured.hit],
    )


MAX_FAILURES = 3
MAX_BYTES = 3_000_000
"""Of the page of samples."""
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
    from scenegen.view.stills import draw, to_bytes

    learned = [method for method in methods if method.learned]
    name, trials = failing(result)
    pictures = []
    for n in trials:
        # predicted again: a result keeps no maps
        index, turn = result.trial_places[n]
        of_trial = partial(guesses, learned, result.config, turn)
        look = look_into(result.dataset.split(result.config.split), index, of_trial)
        caption = f"{name} fails: {look.name}, goal {turn}"
        figure = draw([dataclasses.replace(look, name=f"{look.name}, goal {turn}")], "paths")
        figure.set_dpi(WIDE / figure.get_figwidth())
        pictures.append((caption, to_bytes(figure, ".webp")))
    return pictures


def extremes(report: Json, results: Sequence[DatasetResult], methods: Sequence[Method]) -> str:
    """Make a page of the worst and the median sample of each kind, with the completion of the
    method whose IoU is highest.

    Args:
        report: From `build_report`.
        results: The results by kind of worlds.
        methods: The methods.

    Returns:
        The page, of `MAX_BYTES` at most; "" if only references were measured.

    Raises:
        DatasetError: A grid is too large for a page.
    """
    looks = []
    for result in results:
        order = ranked(report["reconstruction"][result.kind], "iou", METRICS["iou"])
        for _, name in order[:1]:
            ious = result.methods[name].values("iou")
            numbers = np.argsort(ious)[: np.isfinite(ious).sum()]
            chosen = [method for method in methods if method.name == name]
            shown = partial(guesses, chosen, result.config, 0)
            for rank, n in (("worst", numbers[0]), ("median", numbers[len(numbers) // 2])):
                split = result.dataset.split(result.config.split)
                look = look_into(split, result.numbers[n], shown)
                title = f"{result.kind}, {rank} of {name}: {look.name}"
                looks.append(dataclasses.replace(look, name=title))
    notes = list[str]()
    while looks and len(content := page(looks, title="Bench", notes=notes)) > MAX_BYTES:
        looks.pop()
        notes = ["the last kinds are left out: the page would be too large"]
    return content if looks else ""
