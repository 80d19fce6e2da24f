"""A map turned or mirrored about its vertical axis is another map of the same world; its distance
field is turned alike, for tests/scenegen/truth/test_distance.py has it exact."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from lidarsim import GridSpec, Lidar
from lidarsim.sensors.catalogue import MID_360, OS1_64
from scenegen.model.config import TrainConfig
from scenegen.model.inputs import turned
from scenegen.model.training.data import epoch_batches, is_mirrored
from tests.model.training.runs import Counted


def numbered(*shape):
    """A map whose voxels are all different, in no order."""
    return np.random.default_rng(0).permutation(np.prod(shape)).reshape(shape)


def keys_of(maps, epoch=0, **settings):
    """The numbers and symmetries of an epoch's maps."""
    return list(itertools.chain(*epoch_batches(maps, TrainConfig(**settings), epoch)))


@pytest.mark.parametrize("symmetry", range(8))
def test_the_symmetries_are_those_of_a_square(symmetry):
    """As complex numbers have it, with heights untouched: turned about the centre by so many
    quarters, once mirrored in the second four."""
    x, y, z = np.indices((5, 5, 3)) - np.array([2, 2, 0])[:, None, None, None]
    grid = numbered(5, 5, 3)
    place = (x - 1j * y if symmetry >= 4 else x + 1j * y) * 1j ** (symmetry % 4)
    to_x, to_y = np.rint([place.real, place.imag]).astype(int) + 2
    assert_array_equal(turned(grid, symmetry)[to_x, to_y, z], grid)
    assert_array_equal(grid, numbered(5, 5, 3))


@pytest.mark.parametrize("count", [23, 5, 3])
def test_epochs_are_full_batches_of_different_maps(count):
    """Of what is too little for one batch, it is that one; and no map is left out every time."""
    seen, config = set(), TrainConfig(batch=5, seed=3, augment=False)
    for epoch in range(9):
        batches = list(epoch_batches(Counted(count), config, epoch))
        assert [len(keys) for keys in batches] == ([5] * (count // 5) or [count])
        indices, turns = zip(*itertools.chain(*batches), strict=True)
        assert (len(set(indices)), set(turns)) == (len(indices), {0})
        seen |= {*indices}
    assert seen == set(range(count))


@pytest.mark.parametrize("mirrored", [True, False])
@pytest.mark.parametrize(("shape", "step"), [((8, 8, 4), 1), ((8, 6, 4), 2)])
def test_fitting_symmetries_occur_equally_often(shape, step, mirrored):
    """A map as long as it is wide has eight, another has those that keep its shape; half of them
    where rays are no mirror image; each map draws its own in every epoch of every seed."""
    maps = Counted(800, GridSpec(shape=shape), mirrored=mirrored)
    allowed = list(range(0, 8 if mirrored else 4, step))
    places = itertools.product(range(2), repeat=2)
    # of the maps by number
    epochs = [np.array(sorted(keys_of(maps, epoch, seed=seed)))[:, 1] for seed, epoch in places]
    counts = np.bincount(epochs[0], minlength=8)
    assert np.flatnonzero(counts).tolist() == allowed
    usual = 800 / len(allowed)
    assert np.abs(counts[allowed] - usual).max() < 5 * np.sqrt(usual)
    assert {turned(numbered(*shape), symmetry).shape for symmetry in allowed} == {shape}
    assert len({symmetry for _, symmetry in next(epoch_batches(maps, TrainConfig(), 0))}) > 1
    assert min(np.mean(one != two) for one, two in itertools.combinations(epochs, 2)) > 0.4


@pytest.mark.parametrize(
    ("sensor", "mirrored"),
    [
        (Lidar(), True),
        (Lidar(rows=4, columns=7, horizontal_fov_deg=90.0, mount="band"), True),
        (OS1_64, False),
        (MID_360, False),
        (SimpleNamespace(directions_body=np.eye(3)), False),  # some rays are, and one is not
    ],
)
def test_maps_are_mirrored_as_rays_are(sensor, mirrored):
    assert is_mirrored(sensor) is mirrored
