"""Kernels compiled, or loaded, once, before workers are forked that would each do it anew."""

import functools

import numpy as np

from lidarsim import AnalyticEngine, GridSpec, Lidar
from scenegen.draw import draw_unit
from scenegen.recipe import make_recipe
from scenegen.source import DrawnWorlds
from scenegen.verification.archive import compile_solids
from scenegen.verification.twins import candidates, fold, signature


@functools.cache
def warm_up() -> None:
    """Run every kernel that verification needs, on next to nothing: tens of milliseconds once they
    are compiled."""
    field = '<hfield name="h" nrow="2" ncol="2" size="1 1 1 1"/>'
    geoms = '<geom type="box" size="1 1 1"/><geom type="hfield" hfield="h"/>'
    solids = compile_solids(
        f"<mujoco><asset>{field}</asset><worldbody>{geoms}</worldbody></mujoco>".encode(),
        {},
        "warm-up",
    )
    grid, lidar = GridSpec(shape=(24, 24, 16)), Lidar(rows=4, columns=8)
    tables = {
        "flight": {"viewpoints": 1, "margin_m": 2.0, "min_distance_m": 4.0},
        "world": {"size_m": (16.0, 16.0, 8.0)},
        "accept": {"min_solids": 0.0, "min_occupied_share": 0.0, "min_returned_share": 0.0},
        "grid": {"shape": grid.shape},
        "lidar": {"rows": lidar.rows, "columns": lidar.columns},
    }
    recipe = make_recipe("pillar", tables, where="warm-up")
    sample = draw_unit(DrawnWorlds(recipe), recipe, seed=0, split="train", unit=0).samples[0]
    AnalyticEngine(solids).cast([[0.0, 0.0, 5.0]], lidar.directions_body[None], 10.0)
    blocks = signature(sample.occupancy)
    folds = np.stack([fold(sample.observed)] * 2)
    candidates(np.stack([blocks, blocks]), folds, np.array([1, 1]), np.array([0, 1]))
