"""Two small datasets, and a channel that the toolkit does not have; one thread, since tests run side by side."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from scenegen.dataset.build import build, plan_dataset
from scenegen.model.inputs import INPUTS, Input, PointScan
from scenegen.sample import derive_free
from scenegen.source import DrawnWorlds
from tests.conftest import Once, small_recipe

COUNTS = {"train": 12, "val": 6, "test": 5}


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def make_dataset(
    folder: Path, kind: str = "pillar", *, compact: bool = False, counts: dict = COUNTS, **tables: dict
) -> Path:
    """A dataset of a few small maps."""
    recipe = small_recipe(kind, **tables)
    plan = plan_dataset(folder, recipe, DrawnWorlds(recipe), seed=0, counts=counts, compact=compact, shard_samples=5)
    build(plan, workers=1, force=False)
    return folder


@pytest.fixture(scope="session")
def folders(once: Once) -> list[Path]:
    """One dataset of each kind; the second leaves out what can be derived."""
    pillar = once("pillar", make_dataset)
    return [pillar, once("geometric", lambda folder: make_dataset(folder, "geometric", compact=True))]


POSE = ("ranges", "position", "quaternion", "origin")


def crossed(scan: PointScan) -> np.ndarray:
    """The voxels on the way from the sensor to every point, less those of the points."""
    free = np.zeros(scan.grid.shape, bool)
    for share in np.linspace(0.0, 1.0, 200):
        index = scan.grid.index(scan.sensor + share * (scan.points - scan.sensor), scan.origin)
        free[tuple(index[((index >= 0) & (index < scan.grid.shape)).all(axis=1)].T)] = True
    free[tuple(scan.voxels.T)] = False
    return free


FREE = Input(
    of_sample=lambda sample, grid, sensor: derive_free(
        *(getattr(sample, name) for name in POSE), lidar=sensor, grid=grid
    ),
    of_scan=crossed,
)
"""What some ray crossed."""


@pytest.fixture(scope="module")
def free() -> Iterator[None]:
    """Registers `FREE` while the tests of a module run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(INPUTS, "free", FREE)
        yield
