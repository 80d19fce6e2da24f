"""Datasets of generator 1, whose last bits its processor decided, and of other machines: read, and
verified fairly."""

import numpy as np
import pytest

from lidarsim import Pose, Scan, voxelize
from scenegen.dataset import manifest
from scenegen.dataset.read import Dataset
from scenegen.verification import verify
from tests.scenegen.verification import forge
from tests.scenegen.verification.conftest import failed

SHARD = "train-00000.h5"


@pytest.fixture
def older(folder):
    """A dataset that does not name its generator."""
    given = manifest.read(folder)
    del given["generator"]
    manifest.write(folder, given)
    forge.sign(folder)
    return folder


def again(folder):
    return next(check for check in verify(folder).checks if check.name == "regenerated")


def fly_lower(folder):
    """Compute a shard's voxels from a little below the stored place: the level ray then runs under
    the grid's middle, as it would have with another sine."""
    dataset = Dataset(folder)

    def change(arrays):
        for row in range(len(arrays["world"])):
            pose = Pose(arrays["position"][row] - [0.0, 0.0, 1e-14], arrays["quaternion"][row])
            seen = voxelize(
                Scan(arrays["ranges"][row], pose, dataset.lidar),
                dataset.grid,
                arrays["origin"][row],
            )
            arrays["free"][row], arrays["observed"][row] = seen.free, seen.observed

    forge.edit(folder, SHARD, change)


def test_older_datasets_read_and_verify(older):
    assert Dataset(older).split("train")[0].tudf.size
    report = verify(older)
    assert [check.detail for check in report.checks if not check.ok] == []


def test_what_cannot_be_compared_is_counted_and_fails_nothing(older):
    forge.sign(older, seed=1)
    check = again(older)
    assert (check.ok, check.skipped) == (True, True)
    assert check.detail.startswith("not comparable, made by generator 1, here is generator 2: ")
    assert check.counts == {"worlds": 3, "samples": 9, "come out otherwise": 12}
    assert "(3 worlds, 9 samples, 12 come out otherwise)" in check.detail


def test_what_rounding_decides_is_let_pass_in_older_datasets_alone(folder):
    fly_lower(folder)
    assert "free" in failed(folder)
    given = manifest.read(folder)
    del given["generator"]
    manifest.write(folder, given)
    forge.sign(folder)
    assert {"voxels", "free"}.isdisjoint(failed(folder))


@pytest.mark.parametrize("field", ["observed", "free"])
def test_a_voxel_changed_in_an_older_dataset_is_found(older, field):
    def change(arrays):
        values = arrays[field][3]
        values[np.unravel_index(values.argmax(), values.shape)] = False

    forge.edit(older, SHARD, change)
    assert {"observed": "voxels", "free": "free"}[field] in failed(older)
