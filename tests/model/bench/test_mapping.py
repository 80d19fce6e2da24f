"""Networks and the bench meet maps of several scans, and maps that lie ahead."""

import numpy as np

from lidarsim import Scan, voxelize
from scenegen.base.errors import DatasetError
from scenegen.draw.draw import draw_unit
from scenegen.draw.source import DrawnWorlds
from scenegen.model.bench.run import bench
from scenegen.model.bench.visibility import CLASSES, classify, seen_occupancy
from scenegen.model.config import BenchConfig
from tests.conftest import dataset_in, small_recipe
from tests.refusals import refuses


def dataset_with(folder, **mapping):
    recipe = small_recipe(
        mapping=mapping, world={"density": (0.2, 0.2)}, grid={"shape": (40, 40, 16)}
    )
    return dataset_in(folder, recipe, counts={"train": 3, "val": 0, "test": 0})


def test_what_any_scan_could_see_is_in_view():
    recipe = small_recipe(mapping={"scans": 4, "scan_spacing_m": 1.0})
    nothing = np.full(recipe.lidar.shape, np.inf, np.float32)
    for sample in draw_unit(DrawnWorlds(recipe), recipe, seed=0, split="train", unit=0).samples:
        classes = classify(sample, lidar=recipe.lidar, grid=recipe.grid)
        for scan in sample.scans(recipe.lidar):
            view = voxelize(Scan(nothing, scan.pose, recipe.lidar), recipe.grid, sample.origin).free
            assert not (view & (classes == CLASSES.index("out_of_view"))).any()


def test_more_scans_see_more_of_the_obstacles(tmp_path):
    one, four = (
        dataset_with(tmp_path / str(scans), scans=scans, scan_spacing_m=1.0).split("train")
        for scans in (1, 4)
    )
    more = 0
    for alone, several in zip(one, four, strict=True):
        less, seen = seen_occupancy(alone, one), seen_occupancy(several, four)
        assert (less <= seen).all()
        assert (several.observed <= seen).all()
        more += int(seen.sum()) - int(less.sum())
    assert more > 0


def test_plans_do_not_begin_where_no_sensor_is(tmp_path):
    dataset = dataset_with(tmp_path / "d", map_ahead_m=(1.0, 0.0, 0.0))
    refuses("ahead", bench, dataset, [], BenchConfig(split="train"), error=DatasetError)
