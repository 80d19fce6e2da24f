"""Metrics against hand-computed small maps and scipy, and their edge cases."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy import stats

from lidarsim import GridSpec
from scenegen.draw.draw import draw_unit
from scenegen.draw.source import DrawnWorlds
from scenegen.model.bench.metrics import METRICS, measure
from scenegen.model.bench.visibility import (
    CLASSES,
    UNSCORED,
    certain_distances,
    classify,
    scored_voxels,
    walled,
)
from scenegen.model.completion.protocol import Conservative, Empty, Extrude, Prediction, Returns
from scenegen.model.config import Thresholds
from scenegen.truth import distance_field
from tests.conftest import small_recipe
from tests.refusals import refuses

GRID = GridSpec(shape=(7, 6, 5))


def samples_of(recipe):
    return draw_unit(DrawnWorlds(recipe), recipe, seed=0, split="val", unit=1).samples


def measured(prediction, truth, classes, **more):
    """The metrics of the whole map by name; both maps are occupied voxels and distances."""
    rows = measure(*prediction, *truth, classes=classes, class_count=len(CLASSES), **more)
    return dict(zip(METRICS, rows[0], strict=True))


def written_out(occupied, truth, error, near):
    """The metrics of some voxels by name: their definitions."""
    figures = {}
    for part, name in ((error, ""), (error[near], "near_")):
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
    """Of the map, a union of classes and every class."""
    rng = np.random.default_rng(seed)
    grid = GridSpec(shape=(18, 16, 14))
    truth = rng.random(grid.shape) < 0.01  # so that some voxels are just 1 m from it
    occupied, classes = rng.random(grid.shape) < 0.2, rng.integers(0, 3, grid.shape, np.uint8)
    distance, true = 2 * rng.random(grid.shape, np.float32), distance_field(truth, grid)
    assert (true == 1.0).any()
    how = {"classes": classes, "class_count": 3, "union": [0, 2]}
    rows = measure(occupied, distance, truth, true, **how)
    parts = [classes < 3, classes != 1, *(classes == c for c in range(3))]
    for row, part in zip(rows, parts, strict=True):
        error = (distance.astype(float) - true)[part]
        expected = written_out(occupied[part], truth[part], error, true[part] <= 1.0)
        assert dict(zip(METRICS, row, strict=True)) == pytest.approx(expected)


@pytest.mark.parametrize(("occupied", "truth"), [(0, 0), (1, 0), (0, 1)])
def test_empty_maps_have_metrics(occupied, truth):
    grid = GridSpec(shape=(2, 2, 2))
    occupied, truth = (np.full(grid.shape, value, bool) for value in (occupied, truth))
    far, classes = np.full(grid.shape, 2.0, np.float32), np.zeros(grid.shape, np.uint8)
    figures = measured((occupied, far), (truth, distance_field(truth, grid)), classes)
    shares = {figures[name] for name, metric in METRICS.items() if metric.needs == "occupancy"}
    assert shares == {float((occupied == truth).all())}
    assert np.isnan(figures["near_rmse"]) == (not truth.any())


@pytest.mark.parametrize("kind", ["pillar", "geometric"])
def test_classes_mean_what_they_say(kind):
    recipe = small_recipe(kind)
    for sample in samples_of(recipe):
        classes = classify(sample, lidar=recipe.lidar, grid=recipe.grid)
        masks = {name: classes == number for number, name in enumerate(CLASSES)}
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


def test_nothing_below_the_ground_counts(rng):
    recipe = small_recipe("geometric", flight={"altitude_m": (0.5, 1.0)})
    sample, grid, table = samples_of(recipe)[0], recipe.grid, recipe.resolved()["world"]
    scored = scored_voxels(sample, grid, table)
    heights = sample.origin[2] + grid.voxel_m * (np.arange(grid.shape[2]) + 0.5)
    underside = -table["ground_m"]
    assert not scored[..., heights < underside - grid.voxel_m].any()
    assert scored[..., heights > underside].all()
    assert 0 < scored.sum() < scored.size
    classes = classify(sample, lidar=recipe.lidar, grid=grid, scored=scored)
    assert_array_equal(classes == UNSCORED, ~scored)
    occupied, rows = rng.random(grid.shape) < 0.2, []
    for below in (False, True):
        occupied[~scored] = below
        prediction = occupied, np.where(occupied, np.float32(0), sample.tudf)
        rows.append(measured(prediction, (sample.occupancy, sample.tudf), classes))
    assert rows[0] == rows[1]
    assert scored_voxels(sample, grid, {"ground": "grass"}).all()  # somebody's own kind
    assert scored_voxels(sample, grid, table | {"ground": False}).all()


def test_unknown_voxels_count_nowhere(rng):
    """And they are solid for plans."""
    recipe = small_recipe("geometric")
    drawn, grid = samples_of(recipe)[0], recipe.grid
    truth = drawn.occupancy, drawn.tudf
    assert certain_distances(drawn.tudf, None, grid) is None
    known = rng.random(grid.shape) < 0.9
    sample = replace(drawn, known=known, ray_known=np.ones(drawn.ranges.shape, bool))
    scored = scored_voxels(sample, grid, {})
    assert_array_equal(scored, known)
    certain = certain_distances(drawn.tudf, known, grid)
    other = distance_field(drawn.occupancy | (~known & (rng.random(grid.shape) < 0.5)), grid)
    assert_array_equal(other[certain], drawn.tudf[certain])
    classes, rows = np.where(scored, np.uint8(0), np.uint8(UNSCORED)), []
    for wrong in (False, True):
        prediction = (
            np.where(known, drawn.occupancy, wrong),
            np.where(certain, drawn.tudf, np.float32(9.0 * wrong)),
        )
        rows.append(measured(prediction, truth, classes, certain=certain))
    assert rows[0] == rows[1]
    solid, gap = walled(*truth, known, grid)
    assert_array_equal(solid, drawn.occupancy | ~known)
    assert_array_equal(gap, distance_field(solid, grid))


def test_unlearned_methods_do_what_they_say():
    """By columns, of which all others are neither observed nor free."""
    observed, free = np.zeros((2, *GRID.shape), bool)
    observed[2, 3, 2] = free[2, 3, 4] = free[2, 3, 0] = observed[4, 4, 0] = True
    free[4, 4, 1] = free[1, 1, :] = True
    extruded = np.zeros_like(observed)
    extruded[2, 3, 1:4] = extruded[4, 4, 0] = True
    for method, expected in (
        (Empty(), np.zeros_like(observed)),
        (Returns(), observed),
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
