"""A map turned or mirrored about its vertical axis is another map of the same world, and so is its
distance field."""

import itertools
from dataclasses import dataclass

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_array_equal

torch = pytest.importorskip("torch")

from lidarsim import GridSpec, Lidar, MujocoEngine, Pose, cast, voxelize  # noqa: E402
from lidarsim.sensors import SENSORS  # noqa: E402
from scenegen.model.config import TrainConfig  # noqa: E402
from scenegen.model.inputs import turned  # noqa: E402
from scenegen.model.training.data import epoch_batches, is_mirrored  # noqa: E402
from scenegen.truth import distance_field  # noqa: E402

ALL = range(8)
SQUARE = GridSpec(shape=(8, 8, 4))


def numbered(*shape):
    """A map whose voxels are all different, in no order."""
    return np.random.default_rng(0).permutation(np.prod(shape)).reshape(shape)


def which(grid, candidates):
    """The one symmetry whose map this is."""
    (found,) = [s for s, candidate in candidates.items() if np.array_equal(grid, candidate)]
    return found


def table_of(grid, symmetries):
    """Which symmetry it is to turn by a, then by b; fails where it is none or more than one."""
    images = {s: turned(grid, s) for s in symmetries}
    return np.array([[which(turned(images[a], b), images) for b in symmetries] for a in symmetries])


# The group.


@pytest.mark.parametrize("side", [4, 5])
def test_the_eight_symmetries_are_the_dihedral_group(side):
    """Of all groups of order eight only D4 has one, five and two elements of the orders one, two
    and four."""
    table = table_of(numbered(side, side, 3), ALL)
    for line in (*table, *table.T):
        assert sorted(line) == list(ALL)  # closed, and each has an inverse
    assert_array_equal(table[0], ALL)  # the first leaves all as it is
    assert_array_equal(table[:, 0], ALL)
    powers = [[a, table[a, a], table[table[a, a], a], table[table[a, a], table[a, a]]] for a in ALL]
    assert sorted(1 + row.index(0) for row in powers) == [1, 2, 2, 2, 2, 2, 4, 4]
    assert [1 + row.index(0) for row in powers[:4]] == [
        1,
        4,
        2,
        4,
    ]  # quarter turns first, then mirrors
    assert powers[1] == [1, 2, 3, 0]


def test_a_map_longer_one_way_has_the_four_without_a_quarter_turn():
    table = table_of(numbered(5, 4, 3), range(0, 8, 2))
    for line in table:
        assert sorted(line) == [0, 2, 4, 6]
    assert_array_equal(np.diag(table), 0)


@pytest.mark.parametrize("symmetry", ALL)
@pytest.mark.parametrize("side", [6, 7])
def test_height_and_the_distance_from_the_centre_stay(symmetry, side):
    x, y, z = np.indices((side, side, 4))
    middle = (side - 1) / 2
    radius = (x - middle) ** 2 + (y - middle) ** 2
    assert_array_equal(turned(z, symmetry), z)
    assert_array_equal(turned(radius, symmetry), radius)


@pytest.mark.parametrize("symmetry", ALL)
def test_only_the_second_four_mirror(symmetry):
    """What lies ahead and what lies to its left, after the turn: still left, or now right."""
    ahead, left = np.zeros((2, 5, 5, 2))
    ahead[4, 2], left[2, 4] = 1, 1
    (a, b), (c, d) = (np.argwhere(turned(mark, symmetry)[..., 0])[0] - 2 for mark in (ahead, left))
    assert a * d - b * c == (4 if symmetry < 4 else -4)


@pytest.mark.parametrize("symmetry", ALL)
def test_a_map_of_any_kind_is_turned_and_left_alone(symmetry):
    for dtype in (np.bool_, np.uint8, np.float32):
        grid = (numbered(4, 4, 3) % 7).astype(dtype)
        before = grid.copy()
        assert turned(grid, symmetry).dtype == dtype
        assert turned(grid, symmetry).shape == grid.shape
        assert_array_equal(grid, before)


# The distance field.


@pytest.mark.parametrize("symmetry", ALL)
def test_the_field_of_a_turned_map_is_the_turned_field(symmetry):
    for grid in (GridSpec(shape=(11, 11, 6)), GridSpec(shape=(10, 7, 6), voxel_m=0.13)):
        if symmetry % 2 and grid.shape[0] != grid.shape[1]:
            continue
        occupancy = np.random.default_rng(symmetry).random(grid.shape) < 0.01
        occupancy[1, 2, 3] = True
        field = distance_field(occupancy, grid)
        of_turned = distance_field(turned(occupancy, symmetry), grid)
        assert_array_equal(of_turned, turned(field, symmetry))


# The epochs.


@dataclass
class Counted:
    """So many maps, of this grid."""

    count: int
    grid: GridSpec = SQUARE
    shares: None = None
    mirrored: bool = True

    def __len__(self):
        return self.count


@pytest.mark.parametrize("augment", [False, True])
@pytest.mark.parametrize(
    ("count", "batch"), [(23, 5), (20, 5), (5, 5), (6, 5), (3, 5), (1, 8), (7, 1)]
)
def test_an_epoch_is_full_batches_of_maps_seen_once(count, batch, augment):
    """Of what is too little for one batch, it is that one."""
    for epoch in range(4):
        config = TrainConfig(batch=batch, seed=3, augment=augment)
        batches = list(epoch_batches(Counted(count), config, epoch))
        assert [len(keys) for keys in batches] == ([batch] * (count // batch) or [count])
        indices = [index for keys in batches for index, _ in keys]
        assert len(set(indices)) == len(indices)
        assert set(indices) <= set(range(count))


@pytest.mark.parametrize("augment", [False, True])
def test_seed_and_epoch_decide_alone(augment):
    """And each of them matters: seed 0 at epoch 1 is not seed 1 at epoch 0."""

    def drawn(seed, epoch):
        config = TrainConfig(seed=seed, augment=augment)
        return repr([*epoch_batches(Counted(40), config, epoch)])

    pairs = list(itertools.product(range(5), repeat=2))
    first = [drawn(*pair) for pair in pairs]
    np.random.default_rng().random()
    assert [drawn(*pair) for pair in reversed(pairs)] == first[::-1]
    assert len(set(first)) == len(pairs)


def test_no_map_is_left_out_epoch_after_epoch():
    seen = set()
    for epoch in range(20):
        batches = epoch_batches(Counted(15), TrainConfig(), epoch)
        seen |= {index for keys in batches for index, _ in keys}
    assert seen == set(range(15))


def test_nothing_is_turned_unless_asked_for():
    for epoch in range(5):
        config = TrainConfig(augment=False)
        keys = itertools.chain(*epoch_batches(Counted(64), config, epoch))
        assert {symmetry for _, symmetry in keys} == {0}


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
        (SENSORS.find("robosense-helios-16p"), True),
        (SENSORS.find("ouster-os1-64"), False),
        (SENSORS.find("realsense-d435"), True),
        (SENSORS.find("livox-mid-360"), False),
    ],
)
def test_maps_are_mirrored_where_rays_are_their_own_mirror_image(sensor, mirrored):
    assert is_mirrored(sensor) is mirrored


def test_a_mirrored_world_gives_a_mirrored_sensor_the_mirrored_map():
    """What stands behind the mirror: rays, boxes and voxels of a world and of its mirror image,
    cast and gridded."""
    rng = np.random.default_rng(0)
    boxes = [(rng.uniform(-6, 6, 3) * (1, 1, 0.5), rng.uniform(0.1, 0.8, 3)) for _ in range(30)]
    boxes = [(at, half) for at, half in boxes if np.linalg.norm(at[:2]) > 2]
    seen = []
    for sign in (1, -1):
        spec = mujoco.MjSpec()
        for at, half in boxes:
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX, size=half, pos=at * (1, sign, 1)
            )
        seen.append(
            voxelize(
                cast(MujocoEngine.of(spec.compile()), Lidar(), Pose.level(np.zeros(3), 0.3 * sign)),
                GridSpec(),
            )
        )
    for name in ("observed", "free"):
        one, mirror = (getattr(each, name) for each in seen)
        assert (one != turned(one, 4)).sum() > 100
        assert (turned(one, 4) != mirror).mean() < 1e-4, "but for points on a voxel's face"
