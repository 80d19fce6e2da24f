"""Networks and the bench meet maps of several scans, and maps that lie ahead."""

import numpy as np

from lidarsim import Scan, voxelize
from scenegen.draw.draw import draw_unit
from scenegen.draw.source import DrawnWorlds
from scenegen.model.bench.run import bench
from scenegen.model.bench.visibility import CLASSES, classify, seen_occupancy
from scenegen.model.config import BenchConfig
from tests.conftest import dataset_in, small_recipe
from tests.refusals import refuses

MAPPING = {"scans": 4, "scan_spacing_m": 1.0}


def test_whatever_a_scan_could_see_is_in_view():
    recipe = small_recipe(mapping=MAPPING)
    nothing = np.full(recipe.lidar.shape, np.inf, np.float32)
    for sample in draw_unit(DrawnWorlds(recipe), recipe, seed=0, split="train", unit=0).samples:
        classes = classify(sample, lidar=recipe.lidar, grid=recipe.grid)
        for scan in sample.scans(recipe.lidar):
            view = voxelize(Scan(nothing, scan.pose, recipe.lidar), recipe.grid, sample.origin).free
            assert not (view & (classes == CLASSES.index("out_of_view"))).any()


def test_obstacles_of_all_scans_are_seen(tmp_path):
    recipe = small_recipe(mapping=MAPPING, world={"density": (0.2, 0.2)})
    split = dataset_in(tmp_path / "d", recipe).split("train")
    for sample in split:
        seen = seen_occupancy(sample, split)
        assert (sample.observed <= seen).all()


def test_plans_begin_at_the_sensor(tmp_path):
    dataset = dataset_in(tmp_path / "d", small_recipe(mapping={"map_ahead_m": (1.0, 0.0, 0.0)}))
    refuses("ahead", bench, dataset, [], BenchConfig(split="train"))
    refuses("empty", bench, dataset, [], BenchConfig(split="val"))
