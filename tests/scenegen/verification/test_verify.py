"""What is right passes, and every planted fault is caught by name, by forgers who rewrite all
checksums, too."""

import json
import os

import mujoco
import numpy as np
import pytest

from lidarsim import MujocoEngine, Pose
from scenegen.dataset.build import build, plan_dataset
from scenegen.dataset.like import scan_again
from scenegen.dataset.schema import NAME
from scenegen.draw.draw import UnitKey
from scenegen.draw.sample import GROUPS
from scenegen.draw.source import read_scenes
from scenegen.truth import distance_field
from scenegen.verification import verify
from scenegen.verification.folder import CHECKS
from scenegen.worlds.world import compile_world
from tests.command_line import ROOT, run
from tests.conftest import THREE, scene_recipe, small_recipe
from tests.scenegen import cases, refuses
from tests.scenegen.verification import forge
from tests.scenegen.verification.conftest import failed

SHARD = "train-00000.h5"
SCENES = ROOT / "scenes"


@pytest.mark.parametrize(
    ("kind", "quick"), [("pillar", False), ("pillar", True), ("geometric", False)]
)
@pytest.mark.usefixtures("elsewhere")
def test_a_dataset_as_made_passes_every_check_and_is_not_touched(originals, kind, quick):
    def touched():
        return {path.name: path.stat().st_mtime_ns for path in originals[kind].iterdir()}

    told, before = [], touched()
    report = verify(
        originals[kind], quick=quick, on_start=lambda n: told.append(-n), on_done=told.append
    )
    assert [check for check in report.checks if check.skipped or not check.ok] == []
    expected = [check for check in CHECKS if check.field in ("", *GROUPS[""]) and not check.part]
    names = [check.name for check in expected if check.quick or not quick]
    assert [check.name for check in report.checks] == names
    assert (report.ok, report.samples) == (True, 12)
    assert sorted(told) == [-12, 3, 3, 6]
    assert [check["name"] for check in json.loads(json.dumps(report.to_json()))["checks"]] == names
    assert touched() == before


@pytest.mark.parametrize("scene", ["forest.xml", "warehouse.xml"])
def test_worlds_drawn_by_hand_pass(tmp_path, scene):
    source = read_scenes(SCENES / scene, THREE, seed=0)
    build(plan_dataset(tmp_path, scene_recipe(), source, seed=0, counts=THREE))
    assert not [check for check in verify(tmp_path).checks if check.skipped or not check.ok]

    def respell(members):
        members["000000.xml"] = members["000000.xml"].replace(b"pos=", b" pos=", 1)

    forge.rezip(tmp_path / "train-00000.worlds.zip", respell)
    forge.sign(tmp_path)
    told = "is not the world that the manifest's scenes names"
    assert told in failed(tmp_path, quick=True)["archives"]


def roll(arrays):
    for name in ("observed", "free", "occupancy", "tudf"):
        arrays[name][1] = np.roll(arrays[name][1], 1, axis=0)


def move_a_return(arrays):
    ranges = arrays["ranges"][2]
    ranges.flat[np.isfinite(ranges).argmax()] -= 0.01


def nudge_tudf(arrays):
    arrays["tudf"][5, 0, 0, 0] = np.nextafter(arrays["tudf"][5, 0, 0, 0], np.float32(1))


def free_the_observed(arrays):
    arrays["free"][3] |= arrays["observed"][3]


def lose_free(arrays):
    arrays["free"][3].flat[arrays["free"][3].argmax()] = False


def see_what_is_not_there(arrays):
    arrays["observed"][0, ::5] |= ~arrays["occupancy"][0, ::5]


def fill_a_voxel(arrays):
    """The distances are made to match."""
    empty = np.argwhere(~arrays["occupancy"][4])[0]
    arrays["occupancy"][4][tuple(empty)] = True
    arrays["tudf"][4] = distance_field(arrays["occupancy"][4], small_recipe().grid)


def move_the_grid(arrays):
    arrays["origin"][4] += 1e-9


def rename(arrays):
    arrays["viewpoint"][[0, 1]] = arrays["viewpoint"][[1, 0]]


def lengthen(arrays):
    arrays["ranges"][0, 0, :2] = 10.5, np.nan


def stretch_the_attitude(arrays):
    arrays["quaternion"][1] *= 1.001


@pytest.mark.parametrize(
    ("change", "check", "said", "quick"),
    [
        (roll, "voxels", "sample 1: observed is not what follows from ranges", False),
        (move_a_return, "rays", "sample 2: 1 of 192 rays differ", False),
        (nudge_tudf, "tudf", "sample 5: tudf is not what follows from occupancy: 1", False),
        (free_the_observed, "laws", "sample 3", False),
        (lose_free, "free", "sample 3: free is not what follows from ranges: 1", False),
        (see_what_is_not_there, "laws", "observed voxels are not occupied", True),
        (fill_a_voxel, "occupancy", "sample 4: occupancy is not what follows from world 1", False),
        (move_the_grid, "centred", "sample 4: origin is 1e-09 m from position less half", True),
        (stretch_the_attitude, "centred", "sample 1: quaternion has length 1.001", True),
        (rename, "names", "sample 0: is world 0, viewpoint 1, expected (0, 0)", True),
        (lengthen, "laws", "sample 0: 2 ranges are not from 0 to 10 m, or inf", True),
    ],
)
def test_a_forger_who_rewrites_every_digest_is_caught_by_name(folder, change, check, said, quick):
    forge.edit(folder, SHARD, change)
    found = failed(folder, quick=quick)
    assert f"{SHARD}: " in found[check]
    assert said in found[check]
    assert set(found) & {"manifest", "checksums", "layout", "digest", "archives"} == set()


def test_samples_that_are_true_but_not_the_seeds_are_caught(originals, tmp_path):
    """A whole flight is scanned again, a centimetre beside where it was."""
    folder = forge.copy(originals["geometric"], tmp_path / "d")
    members = {}
    forge.rezip(folder / "val-00000.worlds.zip", members.update)
    world = compile_world(members["000000.xml"])
    recipe = small_recipe("geometric")
    forge.edit(folder, "val-00000.h5", lambda arrays: scan_beside(arrays, world, recipe, "val"))
    (told,) = failed(folder).items()
    assert told[0] == "regenerated"
    assert "val-00000.h5: sample 0: observed is not what the seed gives" in told[1]


def scan_beside(arrays, world, recipe, split, moved_m=(0.01, 0.0, 0.0)):
    """Make the samples of a world's flight true ones of other places."""
    places = zip(arrays["position"] + moved_m, arrays["quaternion"], strict=True)
    poses = [[Pose(position, quaternion)] for position, quaternion in places]
    key, engine = UnitKey(0, split, 0), MujocoEngine.of
    again = scan_again(world, poses, recipe, key, names=(0, 0), engine=engine)
    for name in GROUPS[""]:
        arrays[name][:] = [getattr(sample, name) for sample in again.samples]


def put_into_test(folder, document, twin):
    """World 0 of test is that of the `document`, and its samples are those of the arrays `twin`."""
    _, attributes = forge.load(folder, "test-00000.h5")
    forge.rezip(
        folder / "test-00000.worlds.zip", lambda there: there.update({"000000.xml": document})
    )
    forge.store(folder, "test-00000.h5", twin, attributes)


def of_world_0(folder):
    """The document of world 0 of train, and the arrays of its samples."""
    members = {}
    forge.rezip(folder / "train-00000.worlds.zip", members.update)
    arrays, _ = forge.load(folder, SHARD)
    return members["000000.xml"], {name: values[:3].copy() for name, values in arrays.items()}


def rename_and_reorder(document):
    lines = document.decode().splitlines(keepends=True)
    geoms = [n for n, line in enumerate(lines) if "<geom " in line and "type=" in line]
    assert len(geoms) > 2
    for n, line in zip(geoms, [lines[n] for n in reversed(geoms)], strict=True):
        lines[n] = line.replace("<geom ", f'<geom name="renamed {n}" ', 1)
    return "".join(lines).encode()


@pytest.mark.parametrize("quick", [False, True])
def test_a_world_in_two_splits_is_found_whatever_its_geoms_are_called(folder, quick):
    document, twin = of_world_0(folder)
    put_into_test(folder, rename_and_reorder(document), twin)
    found = failed(folder, quick=quick)
    assert "world 0 of test has the same solids as world 0 of train" in found["splits"]
    if not quick:
        assert "test-00000.h5: sample" in found["near-twins"]
        assert "regenerated" in found


def test_a_world_nudged_by_a_centimetre_does_not_hide_a_twin(folder):
    """Everything in the twin is true of its own world: only the two splits together are at
    fault."""
    document, twin = of_world_0(folder)
    spec = mujoco.MjSpec.from_string(document.decode())
    for geom in spec.geoms:
        geom.pos = np.add(geom.pos, [0.01, 0, 0])
    spec.compile()
    world = compile_world(spec.to_xml().encode())
    scan_beside(twin, world, small_recipe(), "test", 0.0)
    put_into_test(folder, world.mjcf, twin)
    found = failed(folder)
    assert set(found) == {"near-twins", "regenerated"}
    assert "shows the map of t" in found["near-twins"]


def test_a_file_beside_the_worlds_is_named(folder):
    def hide(members):
        members["payload.bin"] = b"unasked"

    forge.rezip(folder / "train-00000.worlds.zip", hide)
    forge.sign(folder)
    told = failed(folder, quick=True)["archives"]
    assert told == "train-00000.worlds.zip: no world in it refers to payload.bin"


@pytest.mark.parametrize("resigned", [False, True])
def test_swapped_shards_are_named(folder, resigned):
    for one, other in (("val-00000.h5", "x"), ("test-00000.h5", "val-00000.h5")):
        (folder / one).rename(folder / other)
    (folder / "x").rename(folder / "test-00000.h5")
    if resigned:
        forge.sign(folder)
    found = failed(folder, quick=True)
    assert "val-00000.h5: was written with split 'test', the manifest's is 'val'" in found["layout"]
    assert ("val-00000.h5: SHA-256" in found.get("checksums", "")) is not resigned


def test_a_missing_file_and_an_unlisted_one_are_named(folder):
    (folder / "val-00000.h5").unlink()
    (folder / "train-00007.h5").write_bytes(b"")
    found = failed(folder, quick=True)
    assert "val-00000.h5: is missing" in found["layout"]
    assert "train-00007.h5: in the folder, but dataset.json does not list it" in found["manifest"]


@pytest.mark.parametrize(("path", "value", "check", "said"), cases("verification/verify"))
def test_an_edited_manifest_is_named(folder, path, value, check, said):
    forge.edit_at(folder, path, value)
    assert said in failed(folder, quick=True)[check]


def test_a_recipe_edited_with_every_shard_is_caught_by_what_the_seed_gives(folder):
    forge.sign(folder, seed=1)
    (told,) = failed(folder).items()
    assert told[0] == "regenerated"
    assert ".xml is not the world that the seed gives" in told[1]


def test_what_other_software_made_otherwise_fails_nothing_and_is_no_success(folder, capsys):
    there = forge.read(folder)["software"] | {"mujoco": "9.9"}
    forge.sign(folder, software=there)
    assert (
        run(capsys, f"verify {folder} --quiet --workers 1")[0] == 0
    )  # the same bits, all the same
    forge.sign(folder, software=there, seed=1)
    report = verify(folder)
    assert (report.ok, report.differing) == (True, ("regenerated",))
    (again,) = [check for check in report.checks if check.name == "regenerated"]
    assert (again.ok, again.skipped, again.differing) == (True, False, {"flights": 3})
    assert 'mujoco is "9.9" there' in again.detail
    code, said, told = run(capsys, f"verify {folder} --workers 1")
    assert (code, "19 passed, 1 differ\n" in said) == (3, True)
    assert "no check failed, and regenerated cannot tell" in told
    forge.edit(folder, SHARD, nudge_tudf)  # a fault whoever made it
    assert run(capsys, f"verify {folder} --quiet --workers 1")[0] == 1


def test_only_a_folder_without_a_dataset_raises(tmp_path):
    def refused(told):
        refuses(told, verify, tmp_path)

    refused("not a dataset")
    with open(tmp_path / NAME, "wb") as file:
        os.truncate(file.fileno(), 3 << 30)
    refused("expected 134217728 at most")
    (tmp_path / NAME).unlink()
    os.mkfifo(tmp_path / NAME)
    refused("is not a regular file")


@pytest.fixture
def pair(originals, tmp_path):
    """A collection of two datasets, to plant faults in."""
    for kind in originals:
        forge.copy(originals[kind], tmp_path / "both" / kind)
    return tmp_path / "both"


def test_a_world_in_two_splits_of_a_collection_is_found(pair):
    document, twin = of_world_0(pair / "geometric")
    twin["position"] += [0.0, 0.0, 0.01]  # another sample of it
    put_into_test(pair / "pillar", document, twin)
    told = failed(pair, quick=True)["together"]
    assert "pillar, test: a world has the same solids as one of geometric, train" in told


def test_a_sample_twice_in_a_collection_is_found(originals, tmp_path):
    for name, seed in (("first", 0), ("second", 1)):
        forge.sign(forge.copy(originals["pillar"], tmp_path / "both" / name), seed=seed)
    (told,) = failed(tmp_path / "both", quick=True).items()
    assert told[0] == "together"
    assert "second: holds a sample of first" in told[1]
