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
from tests.command_line import ROOT, done, run
from tests.conftest import THREE, scene_recipe, small_recipe
from tests.refusals import check_wording, refuses
from tests.scenegen import each_case
from tests.scenegen.verification import forge
from tests.scenegen.verification.conftest import finds

SHARD, WORLDS = "train-00000.h5", "train-00000.worlds.zip"
QUICK = {check.name for check in CHECKS if check.quick}


@pytest.mark.parametrize("quick", [False, True])
@pytest.mark.usefixtures("elsewhere")
def test_a_dataset_as_made_passes_every_check_and_is_not_touched(originals, quick):
    folder, reported = originals["pillar"], []
    times = lambda: {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}  # noqa: E731
    before = times()
    report = verify(
        folder, quick=quick, on_start=lambda n: reported.append(-n), on_done=reported.append
    )
    assert [check for check in report.checks if check.skipped or not check.ok] == []
    expected = [check for check in CHECKS if check.field in ("", *GROUPS[""]) and not check.part]
    names = [check.name for check in expected if check.quick or not quick]
    assert [check["name"] for check in json.loads(json.dumps(report.to_json()))["checks"]] == names
    assert (report.ok, report.samples, sorted(reported)) == (True, 12, [-12, 3, 3, 6])
    assert times() == before


def test_worlds_drawn_by_hand_pass(tmp_path):
    source = read_scenes(ROOT / "scenes" / "warehouse.xml", THREE, seed=0)
    build(plan_dataset(tmp_path, scene_recipe(), source, seed=0, counts=THREE))
    assert not [check for check in verify(tmp_path).checks if check.skipped or not check.ok]

    def respell(members):
        members["000000.xml"] = members["000000.xml"].replace(b"pos=", b" pos=", 1)

    forge.rezip(tmp_path / WORLDS, respell)
    forge.sign(tmp_path)
    finds("respelled", tmp_path, "archives", quick=True)


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


def lean(arrays):
    arrays["quaternion"][1] = [np.cos(0.005), np.sin(0.005), 0, 0]


@each_case("verification/forged", "change check")
def test_a_forger_who_rewrites_every_digest_is_caught_by_name(folder, change, check):
    forge.edit(folder, SHARD, globals()[change])
    stored = change not in ("free_the_observed", "lose_free")
    faults = finds(change, folder, check, quick=stored and check in QUICK)
    assert set(faults) & {"manifest", "checksums", "layout", "digest", "archives"} == set()


def scan_beside(arrays, world, recipe, split, moved_m=(0.01, 0.0, 0.0)):
    """Make the samples of a world's flight true ones of other places."""
    places = zip(arrays["position"] + moved_m, arrays["quaternion"], strict=True)
    poses = [[Pose(position, quaternion)] for position, quaternion in places]
    key, engine = UnitKey(0, split, 0), MujocoEngine.of
    again = scan_again(
        world, poses, [np.zeros(1)] * len(poses), recipe, key, names=(0, 0), engine=engine
    )
    for name in GROUPS[""]:
        arrays[name][:] = [getattr(sample, name) for sample in again.samples]


def test_samples_that_are_true_but_not_the_seeds_are_caught(originals, tmp_path):
    """A whole flight is scanned again, a centimetre beside where it was."""
    folder, recipe = forge.copy(originals["geometric"], tmp_path / "d"), small_recipe("geometric")
    world = compile_world(forge.documents(folder, "val-00000.worlds.zip")["000000.xml"])
    forge.edit(folder, "val-00000.h5", lambda arrays: scan_beside(arrays, world, recipe, "val"))
    assert set(finds("moved", folder, "regenerated")) == {"regenerated"}


def of_world_0(folder):
    """The document of world 0 of train, and the arrays of its samples."""
    arrays, _ = forge.load(folder, SHARD)
    samples = {name: values[:3].copy() for name, values in arrays.items()}
    return forge.documents(folder, WORLDS)["000000.xml"], samples


def put_into_test(folder, document, twin):
    """World 0 of test is that of the `document`, and its samples are those of the arrays `twin`."""
    _, attributes = forge.load(folder, "test-00000.h5")
    change = {"000000.xml": document}
    forge.rezip(folder / "test-00000.worlds.zip", lambda members: members.update(change))
    forge.store(folder, "test-00000.h5", twin, attributes)


def rename_and_reorder(document):
    lines = document.decode().splitlines(keepends=True)
    geoms = [n for n, line in enumerate(lines) if "<geom " in line and "type=" in line]
    assert len(geoms) > 2
    for n, line in zip(geoms, [lines[n] for n in reversed(geoms)], strict=True):
        lines[n] = line.replace("<geom ", f'<geom name="renamed {n}" ', 1)
    return "".join(lines).encode()


def test_a_world_in_two_splits_is_found_whatever_its_geoms_are_called(folder):
    document, twin = of_world_0(folder)
    renamed = rename_and_reorder(document)
    put_into_test(folder, renamed, twin)
    finds("renamed", folder, "splits", quick=True)
    # one body more, which only who compiles the world looks through
    inner = renamed.replace(b"<worldbody>", b"<worldbody><body>")
    put_into_test(folder, inner.replace(b"</worldbody>", b"</body></worldbody>"), twin)
    assert {"near-twins", "regenerated"} < finds("inner", folder, "splits").keys()


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
    assert set(finds("nudged", folder, "near-twins")) == {"near-twins", "regenerated"}


@pytest.mark.parametrize("resigned", [False, True])
def test_swapped_shards_are_named(folder, resigned):
    for old, new in (("val-00000.h5", "x"), ("test-00000.h5", "val-00000.h5")):
        (folder / old).rename(folder / new)
    (folder / "x").rename(folder / "test-00000.h5")
    if resigned:
        forge.sign(folder)
    faults = finds("swapped", folder, "layout", quick=True)
    assert ("val-00000.h5: SHA-256" in faults.get("checksums", "")) is not resigned


def test_a_missing_file_and_an_unlisted_one_are_named(folder):
    (folder / "val-00000.h5").unlink()
    (folder / "train-00007.h5").write_bytes(b"")
    for check in ("layout", "manifest"):
        finds(check, folder, check, quick=True)


@each_case("verification/verify", "path value check")
def test_an_edited_manifest_is_named(folder, path, value, check):
    forge.edit_at(folder, path, value)
    finds(f"{path} {value}", folder, check, quick=True)


def test_a_recipe_edited_with_every_shard_is_caught_by_what_the_seed_gives(folder):
    forge.sign(folder, seed=1)
    assert set(finds("seed", folder, "regenerated")) == {"regenerated"}


OTHER = {"mujoco": "9.9"}


@pytest.mark.parametrize("changes", [{"generator": 1}, {"software": OTHER}])
def test_what_others_made_otherwise_fails_nothing_and_is_no_success(folder, changes):
    forge.sign(folder, seed=1, **changes)
    report = verify(folder)
    (again,) = (check for check in report.checks if check.name == "regenerated")
    assert (report.ok, report.differing) == (True, ("regenerated",))
    assert (again.ok, again.skipped, again.differing) == (True, False, {"flights": 3})
    check_wording([*changes], again.detail)


def test_the_command_ends_with_three_if_others_made_other_bits(folder, capsys):
    command = f"verify {folder} --workers 1"
    forge.sign(folder, software=OTHER)
    done(capsys, command)  # the same bits, all the same
    forge.sign(folder, seed=1)
    code, table, message = run(capsys, command)
    assert code == 3
    assert "19 passed, 1 differ\n" in table
    assert "no check failed, and regenerated cannot tell" in message
    forge.edit(folder, SHARD, move_the_grid)  # a fault whoever made it
    assert run(capsys, f"{command} --quick --quiet")[0] == 1


def test_only_a_folder_without_a_dataset_raises(tmp_path):
    folder = tmp_path / "d"  # beside which lies no other test's dataset, to be suggested
    manifest = folder / NAME
    folder.mkdir()
    refuses("empty", verify, folder)
    manifest.touch()
    os.truncate(manifest, 3 << 30)
    refuses("huge", verify, folder)
    manifest.unlink()
    os.mkfifo(manifest)
    refuses("pipe", verify, folder)


def test_a_world_in_two_splits_of_a_collection_is_found(originals, tmp_path):
    for kind in originals:
        forge.copy(originals[kind], tmp_path / kind)
    document, twin = of_world_0(tmp_path / "geometric")
    twin["position"] += [0.0, 0.0, 0.01]  # another sample of it
    put_into_test(tmp_path / "pillar", document, twin)
    finds("two splits", tmp_path, "together", quick=True)


def test_a_sample_twice_in_a_collection_is_found(originals, tmp_path):
    for name, seed in (("first", 0), ("second", 1)):
        forge.sign(forge.copy(originals["pillar"], tmp_path / name), seed=seed)
    assert set(finds("twice", tmp_path, "together", quick=True)) == {"together"}
