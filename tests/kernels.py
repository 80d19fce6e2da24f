"""Every kernel compiled once for all processes that run the tests: each compiles a share, and the
others read it."""

import dataclasses
import fcntl
import hashlib
import os
from collections.abc import Callable

import numpy as np

import scenegen
from lidarsim.jit import cache_folder, cache_trouble

STAMP = f"compiled-for-the-tests-{hashlib.sha256(__file__.encode()).hexdigest()[:16]}"
"""Numba keeps machine code by the path of its source, so what another checkout compiled serves this
one nothing."""


def share(worker, workers, meeting):
    """Compile what no other worker has begun on, starting at this one's part; return when all is in
    the cache.

    `meeting` is a folder that all workers of this run see. Does nothing where an earlier run
    compiled everything, or where nothing can be kept. A lock is free again when its worker has
    ended, however it did, so nobody waits for ever.
    """
    package = scenegen.__name__
    stamp = cache_folder(package) / STAMP
    if cache_trouble(package) or stamp.exists():
        return
    tasks = TASKS[worker * len(TASKS) // workers :] + TASKS[: worker * len(TASKS) // workers]
    for mode in (
        fcntl.LOCK_EX | fcntl.LOCK_NB,
        fcntl.LOCK_EX,
    ):  # what is free first; then what others were busy with
        for task in tasks:
            with open(meeting / f"{task.__name__}.lock", "a") as lock:
                try:
                    fcntl.flock(lock, mode)
                except BlockingIOError:
                    continue
                if os.fstat(lock.fileno()).st_size == 0:
                    task()
                    lock.write("compiled")
                    lock.flush()
    stamp.touch()


def _rasterize():
    from scenegen.truth import rasterize

    rasterize(_nothing(), _grid(), np.zeros(3))
    rasterize(_nothing(), dataclasses.replace(_grid(), hollow=True), np.zeros(3))


def _meshes():
    from scenegen.truth.occupancy import _fill_surface
    from scenegen.truth.triangles import inside_columns

    triangles = np.zeros((1, 3, 3))
    into = (np.zeros(3), 0.2, np.zeros((4, 4, 4), np.bool_))
    _fill_surface(triangles, *into)
    inside_columns(triangles, *into)


def _clearance():
    from scenegen.worlds.clearance import Clearance

    clearance = Clearance(_nothing(), np.array([[0.0, 0, 0], [1, 1, 1]]))
    clearance.motion_is_free((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 0.1)


def _cast():
    from lidarsim import AnalyticEngine

    engine = AnalyticEngine(_nothing())
    engine.hits(np.zeros((1, 3)), np.ones((1, 2, 3)), 10.0)
    engine.move(_nothing())


def _voxelize():
    import mujoco

    from lidarsim import Lidar, MujocoEngine, Pose, cast
    from lidarsim.fusion import Fusion
    from lidarsim.voxelize import crossed, fuse

    engine = MujocoEngine.of(mujoco.MjSpec().compile())
    scan = cast(engine, Lidar(rows=2, columns=4), Pose.level(np.zeros(3), 0.5))
    fuse([scan], _grid(), np.zeros(3), Fusion(fusion="log-odds"))
    crossed(np.zeros(3), np.ones((1, 3)), _grid(), np.zeros(3))


def _distances():
    from scenegen.truth import distance_field

    for truncation_m in (1.0, 3.0, 40.0):  # squares in one byte, in two, in four
        distance_field(np.zeros((4, 4, 4), np.bool_), _grid(truncation_m=truncation_m))


def _chance():
    from lidarsim.elementary import exp, log

    exp(log(1.0))


def _twins():
    from scenegen.verification import splits as between_splits

    maps = np.ones((2, 16, 16, 10), np.bool_)
    signatures, folds = (
        np.array([each(one) for one in maps])
        for each in (between_splits.signature, between_splits.fold)
    )
    between_splits.candidates(signatures, folds, maps.sum(axis=(1, 2, 3)), np.arange(2))


def _plans():
    from scenegen.model.evaluation.config import PlanConfig
    from scenegen.model.evaluation.planning.measure import run_trial

    grid = _grid(shape=(12, 12, 12))
    free, far = np.zeros(grid.shape, np.bool_), np.full(grid.shape, 2.0, np.float32)
    run_trial(free, far, free, far, np.full(3, 9.5 * 0.2), grid, PlanConfig())


def _maps():
    from scenegen.model.completion.unlearned import Extrude
    from scenegen.model.evaluation.metrics import measure
    from scenegen.model.evaluation.uncertainty import count

    grid = _grid()
    free, far = np.zeros(grid.shape, np.bool_), np.full(grid.shape, 2.0, np.float32)
    Extrude().complete(free, free, grid=grid)
    measure(
        free,
        far,
        free,
        far,
        classes=free.view(np.uint8),
        class_count=1,
    )
    count([np.zeros(grid.shape, np.float32)], free, np.zeros((6, *grid.shape), np.bool_))


def _reference():
    from tests.scenegen.truth import reference

    shape = reference.Shape("box", (0.1, 0.1, 0.1))
    reference.judge(shape, (4, 4, 4), 0.2, np.zeros(3))
    reference.judge_hulls(np.zeros((1, 6, 3)), (4, 4, 4), 0.2, np.zeros(3))
    reference.points_inside(shape, np.zeros((1, 3)))


def _nothing():
    """The solids of an empty world: which kernels are compiled does not depend on what stands in
    it."""
    import mujoco

    from lidarsim.solids.model import solids_of

    return solids_of(mujoco.MjSpec().compile())


def _grid(shape=(4, 4, 4), truncation_m=2.0):
    from lidarsim import GridSpec

    return GridSpec(shape=shape, voxel_m=0.2, truncation_m=truncation_m)


TASKS: list[Callable[[], None]] = [
    _rasterize, _meshes, _clearance, _cast, _chance, _maps, _distances, _voxelize, _twins, _plans,
    _reference
]  # fmt: skip
"""Neighbours share kernels, which the first of them compiles; the two halves take about as
long."""
