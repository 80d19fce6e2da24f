"""Metrics against hand-computed small maps and scipy, and their edge cases."""

from dataclasses import replace

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
from scenegen.model.completion.protocol import Conservative, Empty, Extrude, Prediction, Returns
from scenegen.model.config import Thresholds
from scenegen.truth import distance_field
from tests.conftest import small_recipe
from tests.refusals import refuses

GRID = GridSpec(shape=(7, 6, 5))
SUMMED = {name: metric for name, metric in METRICS.items() if metric.needs != "map"}
DISTANCES, SHARES = (
    [name for name, one in METRICS.items() if one.needs == needs]
    for needs in ("distance", "occupancy")
)


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


def samples_of(recipe):
    return draw_unit(DrawnWorlds(recipe), recipe, seed=0, split="val", unit=1).samples


def written_out(occupied, truth, error, near):
    """The metrics of some voxels by name: their definitions."""
    found = {}
    for part, name in ((error, ""), (error[near], "near_")):
        found[f"{name}rmse"] = np.sqrt(np.mean(part**2))
        found[f"{name}mae"] = np.abs(part).mean()
        found[f"{name}bias"] = part.mean()
    (_, misses), (alarms, hits) = stats.contingency.crosstab(occupied, truth).count
    found["iou"] = hits / (hits + misses + alarms)
    precision, recall = hits / (hits + alarms), hits / (hits + misses)
    return found | {
        "precision": precision,
        "recall": recall,
        "f1": stats.hmean([precision, recall]),
    }


@pytest.mark.parametrize("seed", range(5))
def test_metrics_of_the_map_a_union_and_every_class_are_their_definitions(seed):
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
        assert dict(zip(SUMMED, row, strict=True)) == pytest.approx(expected)


def test_nothing_occupied_and_nothing_predicted_are_defined():
    shape, whole = (2, 2, 2), {"classes": np.zeros((2, 2, 2), np.uint8), "class_count": 1}
    none, some, far = np.zeros(shape, bool), np.ones(shape, bool), np.full(shape, 2.0, np.float32)
    for occupied, truth, share in ((none, none, 1), (some, none, 0), (none, some, 0)):
        field = distance_field(truth, GridSpec(shape=shape))
        found = dict(zip(SUMMED, measure(occupied, far, truth, field, **whole)[0], strict=True))
        assert [found[name] for name in SHARES] == [share] * 4
        assert np.isnan(found["near_rmse"]) == (not truth.any())


@pytest.mark.parametrize("kind", ["pillar", "geometric"])
def test_classes_part_the_map_and_mean_what_they_say(kind):
    recipe = small_recipe(kind)
    for sample in samples_of(recipe):
        classes = classify(sample, lidar=recipe.lidar, grid=recipe.grid)
        counts = dict(
            zip(CLASSES, np.bincount(classes.ravel(), minlength=len(CLASSES)), strict=True)
        )
        assert counts["observed"] == sample.observed.sum()
        assert counts["crossed"] == sample.free.sum()
        assert counts["out_of_view"] > 0
        padded = np.pad(sample.occupancy, 1, constant_values=True)  # so counts what is beyond
        around = [
            np.roll(padded, step, axis)[1:-1, 1:-1, 1:-1] for axis in range(3) for step in (1, -1)
        ]
        inside = np.all([sample.occupancy, *around], axis=0) & ~sample.free & ~sample.observed
        assert_array_equal(classes == CLASSES.index("interior"), inside)
        assert counts["occluded"] > 0


def test_nothing_below_the_ground_counts(rng):
    recipe = small_recipe("geometric", flight={"altitude_m": (0.5, 1.0)})
    low = samples_of(recipe)[0]
    grid, table = recipe.grid, recipe.resolved()["world"]
    scored = scored_voxels(low, grid, table)
    heights = low.origin[2] + grid.voxel_m * (np.arange(grid.shape[2]) + 0.5)
    underside = -table["ground_m"]
    assert not scored[..., heights < underside - grid.voxel_m].any()
    assert scored[..., heights > underside].all()
    assert 0 < scored.sum() < scored.size
    classes = classify(low, lidar=recipe.lidar, grid=grid, scored=scored)
    assert_array_equal(classes == UNSCORED, ~scored)
    rows = []
    said = rng.random(grid.shape) < 0.2
    for below in (False, True):
        said[~scored] = below
        far = np.where(said, np.float32(0), low.tudf)
        count = len(CLASSES)
        rows.append(measure(said, far, low.occupancy, low.tudf, classes=classes, class_count=count))
    assert_array_equal(*rows)
    assert scored_voxels(low, grid, {"ground": "grass"}).all()  # somebody's own kind
    table["ground"] = False
    assert scored_voxels(low, grid, table).all()


def test_what_is_not_known_counts_nowhere_and_is_solid_for_plans(rng):
    recipe = small_recipe("geometric")
    drawn = samples_of(recipe)[0]
    grid = recipe.grid
    assert certain_distances(drawn.tudf, None, grid) is None
    known = rng.random(grid.shape) < 0.9
    sample = replace(drawn, known=known, ray_known=np.ones(drawn.ranges.shape, bool))
    scored = scored_voxels(sample, grid, {})
    assert_array_equal(scored, known)
    certain = certain_distances(sample.tudf, known, grid)
    other = distance_field(drawn.occupancy | (~known & (rng.random(grid.shape) < 0.5)), grid)
    assert_array_equal(other[certain], drawn.tudf[certain])
    classes, rows = np.where(scored, np.uint8(0), np.uint8(UNSCORED)), []
    said, distance = drawn.occupancy.copy(), drawn.tudf.copy()
    for wrong in (False, True):
        said[~known], distance[~certain] = wrong, 9.0 * wrong
        rows.append(
            measure(
                said, distance, drawn.occupancy, drawn.tudf,
                classes=classes, class_count=1, certain=certain,
            )
        )  # fmt: skip
    assert_array_equal(*rows)
    solid, gap = walled(drawn.occupancy, drawn.tudf, known, grid)
    assert_array_equal(solid, drawn.occupancy | ~known)
    assert_array_equal(gap, distance_field(solid, grid))


def test_unlearned_methods_do_what_they_say():
    observed, free = np.zeros(GRID.shape, bool), np.zeros(GRID.shape, bool)
    observed[2, 3, 2] = free[2, 3, 4] = free[2, 3, 0] = observed[4, 4, 0] = True
    free[4, 4, 1] = free[1, 1, :] = True
    at = Thresholds()
    empty = Empty().complete(observed, free, grid=GRID)
    assert not empty.occupied(at).any()
    assert (empty.distance(at, GRID) == GRID.truncation_m).all()
    assert_array_equal(Returns().complete(observed, free, grid=GRID).occupied(at), observed)
    assert_array_equal(Conservative().complete(observed, free, grid=GRID).occupied(at), ~free)
    extruded = Extrude().complete(observed, free, grid=GRID).occupied(at)
    assert extruded[2, 3].tolist() == [False, True, True, True, False]
    assert extruded[4, 4].tolist() == [True, False, False, False, False]
    assert extruded.sum() == 4
    for method in (Returns(), Conservative(), Extrude()):
        completion = method.complete(observed, free, grid=GRID)
        expected = distance_field(completion.occupied(at), GRID)
        assert_array_equal(completion.distance(at, GRID), expected)


def test_what_a_completion_leaves_out_is_derived_and_both_left_out_is_refused():
    tudf = np.linspace(0, 3, 8, dtype=np.float32).reshape(2, 2, 2)
    completion = Prediction(tudf=tudf)
    assert_array_equal(completion.occupied(Thresholds(distance_m=0.5)), tudf < 0.5)
    assert completion.distance(Thresholds(), GridSpec(shape=(2, 2, 2))).max() == 2.0
    refuses("neither", Prediction)
