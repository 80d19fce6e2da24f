"""What returned is found as MuJoCo's own rays find it, and the rest of the truth is left out."""

import mujoco
import numpy as np
from numpy.testing import assert_array_equal

from lidarsim.pose import rotate
from lidarsim.solids import solids_of
from scenegen.model.bench.visibility import Seen, seen_occupancy, some_of
from scenegen.model.completion.protocol import check_prediction
from scenegen.model.config import Thresholds
from scenegen.truth import rasterize
from tests.command_line import beside


def test_the_obstacles_are_those_that_mujocos_rays_meet(dataset):
    """Geoms that no ray meets are made invisible, which takes them out of the truth."""
    split = dataset.split("test")
    left_out = 0
    for sample in (split[index] for index in range(0, len(split), 2)):
        files = dataset.world("test", int(sample.world))
        model = mujoco.MjModel.from_xml_string(files.pop("world.xml").decode(), files)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        met, geom = set(), np.zeros(1, np.int32)
        for direction in rotate(sample.quaternion, dataset.lidar.directions_body).reshape(-1, 3):
            distance = mujoco.mj_ray(model, data, sample.position, direction, None, 1, -1, geom)
            if 0 <= distance <= dataset.lidar.max_range_m:
                met.add(int(geom[0]))
        model.geom_rgba[list(set(range(model.ngeom)) - met), 3] = 0.0
        expected = rasterize(solids_of(model), dataset.grid, sample.origin)
        assert_array_equal(seen_occupancy(sample, split), expected)
        assert not (expected & ~sample.occupancy).any()
        assert not (sample.observed & ~expected).any()
        left_out += int((sample.occupancy & ~expected).sum())
        said = check_prediction(Seen().completion(sample, split), dataset.grid.shape, "seen")
        assert_array_equal(said.occupied(Thresholds()), expected)
    assert left_out > 0


def test_some_of_all_kinds_of_solids():
    """Meshes keep their triangles, whichever are taken with them."""
    model = mujoco.MjModel.from_xml_string(beside(__file__, "some.xml"))
    solids = solids_of(model)
    for chosen in ([0, 1], [2, 3], [1], [0, 2], [], [0, 1, 2, 3]):
        some = some_of(solids, chosen)
        assert sorted(some.geom) == chosen
        model.geom_rgba[:, 3] = np.isin(np.arange(4), chosen)
        alone = solids_of(model)
        fields = "shape size position rotation triangles mesh_start mesh_filled geom"
        for name in fields.split():
            assert_array_equal(getattr(some, name), getattr(alone, name))
