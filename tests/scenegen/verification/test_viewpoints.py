"""No viewpoint comes twice, and each is where, and shows as much as, the recipe says."""

import numpy as np
import pytest

from lidarsim import Lidar
from scenegen.dataset.like import plan_like
from scenegen.worlds.world import compile_world
from tests.conftest import dataset_in, small_recipe
from tests.scenegen.conftest import built
from tests.scenegen.verification import forge
from tests.scenegen.verification.conftest import failed, finds
from tests.scenegen.verification.test_verify import SHARD, WORLDS, scan_beside


def repeat_a_viewpoint(arrays):
    """All content of a sample is that of the one before."""
    for name in set(arrays) - {"world", "viewpoint"}:
        arrays[name][5] = arrays[name][4]


@pytest.mark.parametrize("quick", [True, False])
def test_a_viewpoint_under_another_ones_number_is_caught(folder, quick):
    """Whether or not its flight is the one of this shard's that is made again."""
    forge.edit(folder, SHARD, repeat_a_viewpoint)
    for check in ("duplicates", "flights"):
        faults = finds(check, folder, check, quick=quick)
    assert set(faults) - {"regenerated"} == {"duplicates", "flights"}


def scan_at(folder, position):
    """Sample 1 of a world is what its sensor sees at another place, in all that it holds."""
    world = compile_world(forge.documents(folder, WORLDS)["000000.xml"])

    def change(arrays):
        sample = {name: values[1:2] for name, values in arrays.items()}  # views
        sample["position"][:] = position
        viewpoint = sample["viewpoint"].copy()
        scan_beside(sample, world, small_recipe(), "train", 0.0)
        sample["viewpoint"][:] = viewpoint

    forge.edit(folder, SHARD, change)


@pytest.mark.parametrize("apart_m", [0.5, 0.99])
def test_viewpoints_nearer_than_promised_are_caught(folder, apart_m):
    arrays, _ = forge.load(folder, SHARD)
    first, second = arrays["position"][:2]
    scan_at(folder, first + apart_m * (second - first) / np.linalg.norm(second - first))
    assert set(finds(apart_m, folder, "flights", quick=True)) == {"flights"}


def test_a_viewpoint_beyond_where_flights_keep_is_caught(folder):
    """At 1.9 m from the edge of the world, where 2 are kept."""
    arrays, _ = forge.load(folder, SHARD)
    first = arrays["position"][0]
    scan_at(folder, [1.9, 14.0 if first[1] < 8 else 2.0, first[2]])
    finds("edge", folder, "flights", quick=True)


def test_earlier_scans_farther_back_than_promised_are_caught(tmp_path):
    recipe = small_recipe(mapping={"scans": 3, "scan_spacing_m": 0.4})
    folder = dataset_in(tmp_path / "d", recipe).folder

    def move(arrays):
        arrays["earlier_position"][1, 1] += 0.5

    assert failed(folder, quick=True) == {}
    forge.edit(folder, SHARD, move)
    finds("back", folder, "flights", quick=True)


@pytest.mark.parametrize(
    ("name", "field"), [("min_occupied_share", "occupancy"), ("min_returned_share", "ranges")]
)
def test_a_viewpoint_that_the_recipe_rejects_is_caught(folder, name, field):
    """The recipe is edited in all files; the sample that shows the least is named."""
    arrays, _ = forge.load(folder, SHARD)
    values = arrays[field].reshape(len(arrays[field]), -1)
    shares = (values if values.dtype == bool else np.isfinite(values)).mean(axis=1)
    recipe = forge.read(folder)["recipe"]
    limit = float(np.unique(shares)[:2].mean())
    forge.sign(folder, recipe=recipe | {"accept": recipe["accept"] | {name: limit}})
    faults = finds(name, folder, "accepted", quick=True)
    assert set(faults) == {"accepted"}
    row = int(np.argmin(shares))
    assert f"{SHARD}: sample {row}: a share of {shares[row]:.4g} is" in faults["accepted"]


def test_what_noise_loses_is_no_fault(tmp_path):
    mapping = {"tilt_mps": 6.0, "most_tilt_deg": 40.0}
    recipe = small_recipe(noise={"stages": "dropout:0.999"}, mapping=mapping)
    assert failed(dataset_in(tmp_path / "d", recipe).folder) == {}


def test_what_another_sensor_does_not_see_is_no_fault(originals, tmp_path):
    blind = Lidar(rows=2, columns=4, max_range_m=0.21)
    again = built(plan_like(originals["pillar"], tmp_path / "again", lidar=blind))
    assert not np.isfinite([sample.ranges for sample in again.split("train")]).any()
    assert failed(again.folder) == {}
