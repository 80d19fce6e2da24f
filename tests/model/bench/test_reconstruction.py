"""Metrics against hand-computed small maps and scipy, and their edge cases."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy import stats

from lidarsim import GridSpec
from scenegen.draw.draw import draw_unit
from scenegen.draw.source import DrawnWorlds
from scenegen.model.bench.metrics import METRICS, ScoredMap
from scenegen.model.bench.metrics import measure as measure_map
from scenegen.model.bench.visibility import (
    CLASSES,
    UNSCORED,
    certain_distances,
    classify,
    scored_voxels,
    walled,
)
from scenegen.model.completion.protocol import (
    Conservative,
    Empty,
    Extrude,
    Prediction,
    ReturnsCompleter,
)
from scenegen.model.config import Thresholds
from scenegen.truth import distance_field
from tests.conftest import small_recipe
from tests.refusals import refuses
from tests.scenegen import each_case

GRID = GridSpec(shape=(7, 6, 5))
SUMMED = {name: metric for name, metric in METRICS.items() if metric.needs != "map"}


def measure(occupied, distance, truth, true, *, classes, class_count, certain=None, union=()):
    """The metrics that are sums over voxels."""
    judged = ScoredMap(
        prediction=Prediction(occupancy_probability=occupied.astype(np.float32), tudf=distance),
        truth={"occupancy": truth, "tudf": true},
        grid=GRID,
        thresholds=Thresholds(),
        scored=classes < class_count,
        certain=certain,
    )
    return measure_map(judged, SUMMED, classes=classes, class_count=class_count, union=union)


def written_out(occupied, truth, error, near):
    """The metrics of some voxels by name: their definitions."""
    figures = {}
    for part, name in ((error, ""), (near, "near_")):
        figures[f"{name}rmse"] = np.sqrt(np.mean(part**2))
        figures[f"{name}mae"] = np.abs(part).mean()
        figures[f"{name}bias"] = part.mean()
    (_, misses), (alarms, hits) = stats.contingency.crosstab(occupied, truth).count
    precision, recall = hits / (hits + alarms), hits / (hits + misses)
    return figures | {
        "iou": hits / (hits + misses + alarms),
        "precision": precision,
        "recall": recall,
        "f1": stats.hmean([precision, recall]),
    }


@pytest.mark.parametrize("seed", range(5))
def test_metrics_are_their_definitions(seed):
    """Of the map, a union of classes and every class; of voxels that are scored, and distances that
    are certain."""
    rng = np.random.default_rng(seed)
    grid = GridSpec(shape=(18, 16, 14))
    truth = rng.random(grid.shape) < 0.01  # so that some voxels are just 1 m from it
    occupied, classes = rng.random(grid.shape) < 0.2, rng.integers(0, 4, grid.shape, np.uint8)
    classes[classes == 3] = UNSCORED
    certain = rng.random(grid.shape) < 0.8 if seed else None
    distance, true = 2 * rng.random(grid.shape, np.float32), distance_field(truth, grid)
    assert (true == 1.0).any()
    how = {"classes": classes, "class_count": 3, "union": [0, 2], "certain": certain}
    rows = measure(occupied, distance, truth, true, **how)
    error, sure = distance.astype(float) - true, True if certain is None else certain
    for row, union in zip(rows, [(0, 1, 2), (0, 2), (0,), (1,), (2,)], strict=True):
        part = np.isin(classes, union)
        near = error[part & sure & (true <= 1.0)]
        expected = written_out(occupied[part], truth[part], error[part & sure], near)
        assert dict(zip(SUMMED, row, strict=True)) == pytest.approx(expected)


@pytest.mark.parametrize(("occupied", "truth"), [(0, 0), (1, 0), (0, 1)])
def test_empty_maps_have_metrics(occupied, truth):
    occupied, truth = (np.full(GRID.shape, value, bool) for value in (occupied, truth))
    far, classes = np.full(GRID.shape, 2.0, np.float32), np.zeros(GRID.shape, np.uint8)
    how = {"classes": classes, "class_count": 1}
    row, *_ = measure(occupied, far, truth, distance_field(truth, GRID), **how)
    figures = dict(zip(SUMMED, row, strict=True))
    shares = {figures[name] for name, metric in METRICS.items() if metric.needs == "occupancy"}
    assert shares == {float((occupied == truth).all())}
    assert np.isnan(figures["near_rmse"]) == (not truth.any())


@pytest.mark.parametrize("kind", ["pillar", "geometric"])
def test_classes_mean_what_they_say(kind, rng):
    recipe = small_recipe(kind)
    for sample in draw_unit(DrawnWorlds(recipe), recipe, seed=0, split="val", unit=1).samples:
        scored = rng.random(recipe.grid.shape) < 0.9
        classes, all_classes = (
            classify(sample, lidar=recipe.lidar, grid=recipe.grid, scored=mask)
            for mask in (scored, None)
        )
        assert_array_equal(classes, np.where(scored, all_classes, UNSCORED))
        masks = {name: all_classes == number for number, name in enumerate(CLASSES)}
        assert_array_equal(masks["observed"], sample.observed)
        assert_array_equal(masks["crossed"], sample.free)
        padded = np.pad(sample.occupancy, 1, constant_values=True)  # so counts what is beyond
        around = [
            np.roll(padded, step, axis)[1:-1, 1:-1, 1:-1] for axis in range(3) for step in (1, -1)
        ]
        inside = np.all([sample.occupancy, *around], axis=0) & ~sample.free & ~sample.observed
        assert_array_equal(masks["interior"], inside)
        assert masks["out_of_view"].any()
        assert masks["occluded"].any()


@each_case("../model/grounds", "world below", json.loads)
def test_layers_below_the_ground_are_unscored(world, below):
    """The third layer ends 0.4 m below 0. Grass is somebody's own kind of ground."""
    sample = SimpleNamespace(origin=np.array([0.0, 0.0, -1.0]), known=None)
    expected = np.broadcast_to(np.arange(5) >= below, GRID.shape)
    assert_array_equal(scored_voxels(sample, GRID, world), expected)


def test_unknown_voxels_are_unscored_and_solid(rng):
    """Certain distances are those that no unknown voxel can change."""
    occupied, known = rng.random((2, *GRID.shape)) < [[[[0.05]]], [[[0.95]]]]
    sample = SimpleNamespace(origin=np.zeros(3), known=known)
    assert_array_equal(scored_voxels(sample, GRID, None), known)
    distance = distance_field(occupied & known, GRID)
    certain = certain_distances(distance, known, GRID)
    solid, gap = walled(occupied & known, distance, known, GRID)
    assert_array_equal(solid, occupied & known | ~known)
    assert_array_equal(gap, distance_field(solid, GRID))
    assert_array_equal(certain, gap == distance)
    assert 0 < certain.sum() < certain.size
    assert certain_distances(distance, None, GRID) is None


def test_unlearned_methods_do_what_they_say():
    """By columns, of which all others are neither observed nor free."""
    observed, free = np.zeros((2, *GRID.shape), bool)
    observed[2, 3, 2] = free[2, 3, 4] = free[2, 3, 0] = observed[4, 4, 0] = True
    free[4, 4, 1] = free[1, 1, :] = True
    extruded = np.zeros_like(observed)
    extruded[2, 3, 1:4] = extruded[4, 4, 0] = True
    for method, expected in (
        (Empty(), np.zeros_like(observed)),
        (ReturnsCompleter(), observed),
        (Conservative(), ~free),
        (Extrude(), extruded),
    ):
        prediction = method.complete(observed, free, grid=GRID)
        assert_array_equal(prediction.occupied(Thresholds()), expected)
        distance = prediction.distance(Thresholds(), GRID)
        assert_array_equal(distance, distance_field(expected, GRID))


def test_predictions_derive_what_they_leave_out():
    tudf = np.linspace(0, 3, 8, dtype=np.float32).reshape(2, 2, 2)
    prediction = Prediction(tudf=tudf)
    assert_array_equal(prediction.occupied(Thresholds(distance_m=0.5)), tudf < 0.5)
    assert prediction.distance(Thresholds(), GridSpec(shape=(2, 2, 2))).max() == 2.0
    refuses("neither", Prediction)
