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

ALL = range(8)


def numbered(*shape):
    """A map whose voxels are all different, in no order."""
    return np.random.default_rng(0).permutation(np.prod(shape)).reshape(shape)


# The group.


def test_the_eight_symmetries_are_those_of_a_square():
    """As complex numbers have it, with heights untouched: turned about the centre by so many
    quarters, once mirrored in the second four."""
    x, y, z = np.indices((5, 5, 3)) - np.array([2, 2, 0])[:, None, None, None]
    for symmetry in ALL:
        grid = numbered(5, 5, 3)
        before = grid.copy()
        found = turned(grid, symmetry)
        assert_array_equal(grid, before)
        place = (x - 1j * y if symmetry >= 4 else x + 1j * y) * 1j ** (symmetry % 4)
        at = np.rint([place.real, place.imag]).astype(int) + 2
        assert_array_equal(found[at[0], at[1], z], grid)


# The epochs.


@pytest.mark.parametrize(("count", "batch"), [(23, 5), (5, 5), (3, 5)])
def test_an_epoch_is_full_batches_of_maps_seen_once(count, batch):
    """Of what is too little for one batch, it is that one; and no map is left out every time."""
    seen = set()
    for epoch in range(9):
        config = TrainConfig(batch=batch, seed=3, augment=False)
        batches = list(epoch_batches(Counted(count), config, epoch))
        assert [len(keys) for keys in batches] == ([batch] * (count // batch) or [count])
        indices, turns = zip(*itertools.chain(*batches), strict=True)
        assert len(set(indices)) == len(indices)
        assert set(turns) == {0}
        seen |= {*indices}
    assert seen == set(range(count))


def test_seed_and_epoch_decide_alone():
    """And each of them matters: seed 0 at epoch 1 is not seed 1 at epoch 0."""

    def drawn(seed, epoch):
        return repr([*epoch_batches(Counted(40), TrainConfig(seed=seed), epoch)])

    pairs = list(itertools.product(range(3), repeat=2))
    first = [drawn(*pair) for pair in pairs]
    assert [drawn(*pair) for pair in reversed(pairs)] == first[::-1]
    assert len(set(first)) == len(pairs)


@pytest.mark.parametrize(
    ("shape", "mirrored", "allowed"),
    [
        ((8, 8, 4), True, tuple(ALL)),
        ((8, 6, 4), True, (0, 2, 4, 6)),
        ((8, 8, 4), False, (0, 1, 2, 3)),
        ((8, 6, 4), False, (0, 2)),
    ],
)
def test_symmetries_that_fit_the_map_occur_about_as_often(shape, mirrored, allowed):
    """A map as long as it is wide has eight, another has those that keep its shape; half of them
    where rays are no mirror image; each map draws its own."""
    maps = Counted(800, GridSpec(shape=shape), mirrored=mirrored)
    epochs = [list(epoch_batches(maps, TrainConfig(), epoch)) for epoch in range(2)]
    drawn = [symmetry for keys in epochs[0] for _, symmetry in keys]
    assert sorted(set(drawn)) == list(allowed)
    counts = np.bincount(drawn)[list(allowed)]
    assert np.abs(counts - 800 / len(allowed)).max() < 5 * np.sqrt(800 / len(allowed))
    assert all(turned(numbered(*shape), symmetry).shape == shape for symmetry in set(drawn))
    assert max(len({symmetry for _, symmetry in keys}) for keys in epochs[0]) > 1
    first, second = (dict(itertools.chain(*epoch)) for epoch in epochs)
    assert np.mean([first[i] != second[i] for i in first]) > 0.4


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
def test_maps_are_mirrored_where_rays_are_their_own_mirror_image(sensor, mirrored):
    assert is_mirrored(sensor) is mirrored
