"""Warp's kernels, in its mode without a GPU: the bits of the analytic engine and of `voxelize`."""

import importlib
import sys

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_array_equal

import lidarsim
from lidarsim import AnalyticEngine, GridSpec, Lidar, Pose
from lidarsim.gpu import WarpEngine
from lidarsim.pose import rotate
from lidarsim.solids.model import solids_of
from tests.lidarsim.engines.test_laws import SORTS, model_of, random_model, random_rays
from tests.lidarsim.reference import unit

wp = pytest.importorskip("warp", reason="NVIDIA Warp is not installed: pip install -e '.[gpu]'")

from lidarsim.gpu.rays import cast, voxelize  # noqa: E402
from lidarsim.gpu.worlds import Worlds  # noqa: E402

AXES = np.concatenate([np.eye(3), -np.eye(3)])


def test_many_worlds_at_once_give_the_analytic_engines_bits(rng):
    solids = [solids_of(random_model(rng)) for _ in range(4)]
    plane_alone = model_of('type="plane" size="2 0 1"')
    solids += [solids_of(model_of()), solids_of(plane_alone)]  # no solid, no box
    which = np.array([3, 1, 0, 5, 2, 2, 4, 0, 1])
    origins, rays = random_rays(rng, len(which), 1000)
    origins[0], origins[1] = solids[3].position[4] + 0.1, solids[1].position[7]  # inside a solid
    rays[:, :6] = AXES
    rays[:, 6:200, 2] = 0.0
    for p, world in enumerate(which):  # at corners, where triangles meet
        corners = solids[world].triangles.reshape(-1, 3)[:100]
        rays[p, 220 : 220 + len(corners)] = corners - origins[p]
    rays = unit(rays)
    rays[:, 200:220] *= 1 + np.linspace(-9e-7, 9e-7, 20)[:, None]  # units to a millionth
    for reach in (6.0, 1e7):
        ranges = cast(Worlds(solids, device="cpu"), origins, rays, reach, which=which).numpy()
        for p, world in enumerate(which):
            alone = AnalyticEngine(solids[world]).cast(origins[p : p + 1], rays[p : p + 1], reach)
            assert_array_equal(ranges[p], alone[0])
        assert 500 < np.isfinite(ranges).sum() < ranges.size - 500


def test_rays_along_the_axes_are_the_analytic_engines():
    """From points level with faces, edges and centres, along all axes: where products of 0 and
    infinity would lurk."""
    sorts = [*SORTS, 'type="mesh" mesh="n"']
    model = model_of(*(f'{sort} pos="{4 * n} 0 0"' for n, sort in enumerate(sorts)))
    steps = np.array([-0.8, -0.6, -0.5, -0.3, 0.0, 0.3, 0.5, 0.7, 0.8])
    around = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    places = range(-3, 4 * len(sorts))
    origins = np.concatenate([around + np.array([x, 0, 0]) for x in places])
    rays = np.broadcast_to(AXES, (len(origins), 6, 3))
    ranges = WarpEngine(solids_of(model), device="cpu").cast(origins, rays, 100.0)
    assert_array_equal(ranges, AnalyticEngine.of(model).cast(origins, rays, 100.0))


def test_voxels_are_those_of_voxelize():
    rng, lidar = np.random.default_rng(2), Lidar(rows=24, columns=90, max_range_m=7.1)
    models = [random_model(rng) for _ in range(3)]
    # rays in the grid's own planes
    poses = [Pose.level((3 + 6 * n, 3 * n, 0.4 * n), 0.5 * np.pi * n) for n in range(3)]
    origins = np.array([pose.position for pose in poses])
    rays = np.array([rotate(p.quaternion, lidar.directions_body).reshape(-1, 3) for p in poses])
    ranges = cast(Worlds(map(solids_of, models), device="cpu"), origins, rays, lidar.max_range_m)
    near, behind = GridSpec(shape=(40, 30, 20), voxel_m=0.25), GridSpec(shape=(9, 7, 30))
    for grid, shift in ((near, 0.0), (behind, 3.05)):
        low = grid.origin_at(origins) + shift  # of the second, a part lies behind the sensor
        observed, free = voxelize(ranges, origins, rays, lidar.max_range_m, grid=grid, corners=low)
        for p, (model, pose) in enumerate(zip(models, poses, strict=True)):
            scan = lidarsim.cast(AnalyticEngine.of(model), lidar, pose)
            seen = lidarsim.voxelize(scan, grid, low[p])
            assert_array_equal(observed.numpy()[p], seen.observed)
            assert_array_equal(free.numpy()[p], seen.free)
        assert observed.numpy().any()
        assert free.numpy().any()


def test_torch_takes_and_gives_arrays_without_a_copy():
    torch = pytest.importorskip("torch")
    solids = solids_of(model_of('type="sphere" size="1" pos="5 0 0"'))
    directions = torch.tensor(np.tile(AXES, (2, 1, 1)))
    origins = torch.zeros((2, 3), dtype=torch.float64)
    given = [wp.from_torch(tensor, dtype=wp.vec3d) for tensor in (origins, directions)]
    ranges = cast(Worlds([solids, solids], device="cpu"), *given, 10.0)
    tensor = wp.to_torch(ranges)
    assert tensor.data_ptr() == ranges.ptr
    assert tensor[:, 0].tolist() == [4.0, 4.0]
    assert torch.isinf(tensor[:, 1:]).all()


def test_what_a_kernel_cannot_take_is_refused_in_one_line():
    worlds = Worlds([solids_of(model_of())], device="cpu")
    three = wp.zeros(3, dtype=wp.vec3d, device="cpu")
    for origins, which, message in (
        (np.zeros((2, 3)), [0, 1], "which: 0 to 1, expected 2 integers from 0 to 0"),
        (np.zeros((2, 3)), [0.0, 0.0], "which: float64"),
        (np.zeros((2, 2)), [0, 0], r"origins: an array \(2, 2\), expected \(2, 3\)"),
        (three, [0, 0], r"origins: an array \(3,\) of vec3d on cpu, expected \(2,\)"),
    ):
        with pytest.raises(ValueError, match=message):
            cast(worlds, origins, np.ones((2, 5, 3)), 1.0, which=which)
    with pytest.raises(ValueError, match="no worlds"):
        Worlds([], device="cpu")


@pytest.mark.skipif(WarpEngine.missing() == "", reason="a GPU is here")
def test_what_is_missing_is_named(monkeypatch):
    with pytest.raises(ValueError, match=r"^the engine warp needs an NVIDIA GPU"):
        WarpEngine.of(mujoco.MjModel.from_xml_string("<mujoco/>"))
    with pytest.raises(ValueError, match="Warp finds no GPU on this machine"):
        Worlds([solids_of(model_of())])
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert "pip install -e '.[gpu]'" in WarpEngine.missing()
    monkeypatch.setitem(sys.modules, "warp", None)
    monkeypatch.delitem(sys.modules, "lidarsim.gpu.worlds")
    with pytest.raises(ImportError, match=r"needs NVIDIA Warp.*\.\[gpu\]"):
        importlib.import_module("lidarsim.gpu.worlds")


@pytest.mark.slow
def test_kernels_compile_for_gpus_without_fused_multiplications(tmp_path):
    """A fused multiplication rounds once where the processor rounds twice, and bits would differ.
    No GPU is needed."""
    for name in ("lidarsim.gpu.rays", "scenegen.truth.gpu"):
        module = importlib.import_module(name)
        wp.compile_aot_module(module, arch=86, module_dir=str(tmp_path), use_ptx=True)
    found = [path.read_text() for path in tmp_path.glob("*.ptx")]
    assert len(found) == 2
    for code in found:
        assert "mul.rn.f64" in code
        assert "mul.f64" not in code  # which the assembler may fuse
        assert "fma.rn.f64" not in code
        assert ".approx" not in code
