"""No viewpoint comes twice, and each is where, and shows as much as, the recipe says."""

import numpy as np
import pytest

from lidarsim import Lidar, MujocoEngine, Pose
from scenegen.dataset.like import plan_like, scan_again
from scenegen.draw.draw import UnitKey
from scenegen.draw.sample import GROUPS
from scenegen.worlds.world import compile_world
from tests.conftest import dataset_in, small_recipe
from tests.scenegen.conftest import built
from tests.scenegen.verification import forge
from tests.scenegen.verification.conftest import failed

SHARD = "train-00000.h5"
NAMES = ("world", "viewpoint")


def copy_content(arrays, row, others, other):
    """Everything in a sample is true, of another viewpoint."""
    for name, values in arrays.items():
        if name not in NAMES:
            values[row] = others[name][other]


@pytest.mark.parametrize("quick", [True, False])
def test_a_viewpoint_under_another_ones_number_is_caught(folder, quick):
    """Whether or not its flight is the one of this shard's that is made again."""
    forge.edit(folder, SHARD, lambda arrays: copy_content(arrays, 5, arrays, 4))
    found = failed(folder, quick=quick)
    assert set(found) - {"regenerated"} == {"duplicates", "flights"}
    told = f"{SHARD}: sample 5 has the content of {SHARD}: sample 4, expected that of another"
    assert told in found["duplicates"]
    assert "samples 4 and 5 of train are of one flight and 0 m apart" in found["flights"]


def scan_at(folder, position):
    """Sample 1 of a world is what its sensor sees at another place, in all that it holds."""
    members = {}
    forge.rezip(folder / "train-00000.worlds.zip", members.update)
    world, recipe = compile_world(members["000000.xml"]), small_recipe()

    def change(arrays):
        pose = Pose(position, arrays["quaternion"][1])
        key, engine = UnitKey(0, "train", 0), MujocoEngine.of
        unit = scan_again(world, [[pose]], recipe, key, names=(0, 1), engine=engine)
        for name in GROUPS[""]:
            arrays[name][1] = getattr(unit.samples[0], name)

    forge.edit(folder, SHARD, change)


@pytest.mark.parametrize("apart_m", [0.5, 0.99])
def test_viewpoints_nearer_than_promised_are_caught(folder, apart_m):
    arrays, _ = forge.load(folder, SHARD)
    first, second = arrays["position"][:2]
    away = (second - first) / np.linalg.norm(second - first)
    scan_at(folder, first + apart_m * away)
    found = failed(folder)
    assert set(found) - {"regenerated"} == {"flights"}
    assert (
        f"{SHARD}: samples 0 and 1 of train are of one flight and {apart_m:g} m apart, expected "
        "flight.spacing_m = 1" in found["flights"]
    )


def test_a_viewpoint_beyond_where_flights_keep_is_caught(folder):
    """At 1.9 m from the edge of the world, where 2 are kept."""
    arrays, _ = forge.load(folder, SHARD)
    first = arrays["position"][0]
    scan_at(folder, [1.9, 14.0 if first[1] < 8 else 2.0, first[2]])
    found = failed(folder, quick=True)
    assert f"{SHARD}: sample 1: its position [1.9, " in found["flights"]
    assert "is not within [2.0, 2.0, " in found["flights"]


def test_a_body_that_leans_where_none_should_is_caught(folder):
    def lean(arrays):
        arrays["quaternion"][1] = [np.cos(0.005), np.sin(0.005), 0, 0]

    forge.edit(folder, SHARD, lean)
    told = f"{SHARD}: sample 1: a body leans by more than 0 degrees"
    assert told in failed(folder, quick=True)["centred"]


def test_earlier_scans_farther_back_than_promised_are_caught(tmp_path):
    recipe = small_recipe(mapping={"scans": 3, "scan_spacing_m": 0.4})
    folder = dataset_in(tmp_path / "d", recipe).folder

    def move(arrays):
        arrays["earlier_position"][1, 1] += 0.5

    assert failed(folder, quick=True) == {}
    forge.edit(folder, SHARD, move)
    found = failed(folder, quick=True)["flights"]
    assert f"{SHARD}: sample 1: from scan to scan are " in found
    assert "expected at most mapping.scan_spacing_m = 0.4" in found


@pytest.mark.parametrize("name", ["min_occupied_share", "min_returned_share"])
def test_a_viewpoint_that_the_recipe_rejects_is_caught(folder, name):
    """The recipe is edited in all files; the sample that shows the least is named."""
    arrays, _ = forge.load(folder, SHARD)
    shows = {
        "min_occupied_share": arrays["occupancy"].mean(axis=(1, 2, 3)),
        "min_returned_share": np.isfinite(arrays["ranges"]).mean(axis=(1, 2)),
    }[name]
    recipe = forge.read(folder)["recipe"]
    least = float(np.unique(shows)[:2].mean())
    forge.sign(folder, recipe=recipe | {"accept": recipe["accept"] | {name: least}})
    found = failed(folder, quick=True)
    assert set(found) == {"accepted"}
    row = int(np.argmin(shows))
    assert f"{SHARD}: sample {row}: a share of {shows[row]:.4g} is too small" in found["accepted"]
    assert f"accept.{name} = {least:g}" in found["accepted"]


def test_what_noise_loses_and_another_sensor_does_not_see_is_no_fault(tmp_path):
    recipe = small_recipe(
        noise={"stages": "dropout:0.999"}, mapping={"tilt_mps": 6.0, "most_tilt_deg": 40.0}
    )
    noisy = dataset_in(tmp_path / "d", recipe)
    assert failed(noisy.folder) == {}
    blind = Lidar(rows=2, columns=4, max_range_m=0.21)
    again = built(plan_like(noisy.folder, tmp_path / "again", lidar=blind))
    assert not np.isfinite([sample.ranges for sample in again.split("train")]).any()
    assert failed(again.folder) == {}
