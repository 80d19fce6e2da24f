"""Importing, loading and reading what is stored import nothing that draws, casts, derives or
learns."""

import pytest

from tests.command_line import modules_after
from tests.conftest import dataset_in

HEAVY = {"mujoco", "ompl", "numba", "scipy", "trimesh", "torch", "multiprocessing"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return dataset_in(tmp_path_factory.mktemp("light") / "d", compact=True).folder


def test_importing_loading_and_reading_what_is_stored_is_light(folder):
    """Where all together import nothing heavy, neither does any alone."""
    code = f"""
import scenegen, lidarsim, scenegen.model.config, scenegen.__main__, scenegen.dataset.read
assert not hasattr(lidarsim, "absent")
samples = scenegen.load({str(folder)!r})
samples[0].observed, samples[1].ranges, samples[2].position, samples.names, samples.describe()
samples.dataset.manifest.grid, samples.dataset.manifest.lidar, samples.dataset.world("train", 0)
"""
    assert not modules_after(code) & HEAVY
    assert "mujoco" in modules_after("from lidarsim import MujocoEngine")


def test_streaming_inspecting_and_viewing_need_no_torch(folder, tmp_path):
    code = f"""
import scenegen
from scenegen.__main__ import app
from tests.conftest import small_recipe
stream = scenegen.stream(small_recipe())
stream.__getitems__(next(stream.batches(2)))
next(iter(stream)).tudf
app.main(["inspect", {str(folder)!r}], standalone_mode=False)
app.main(["view", {str(folder)!r}, "-o", {str(tmp_path / "page.html")!r}], standalone_mode=False)
"""
    assert "torch" not in modules_after(code)
