"""Samples with movers: truth over time, what the checks find, and what does not change."""

import dataclasses
from contextlib import suppress

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import scenegen
from scenegen.base.errors import DatasetError
from scenegen.dataset.selection import MEASURES
from scenegen.draw.draw import truth_of
from scenegen.worlds.labels import labels_by
from scenegen.worlds.recipe import read_recipe
from scenegen.worlds.tables import named_lidar
from scenegen.worlds.traffic import KINDS, PRESETS, Traffic
from tests.command_line import ROOT, code_of, done
from tests.conftest import dataset_in, hall_in, small_recipe
from tests.refusals import refuses, refuses_command
from tests.scenegen.conftest import drawn_unit
from tests.scenegen.verification import forge
from tests.scenegen.verification.conftest import failed

WAREHOUSE = ROOT / "scenes" / "warehouse.xml"
CROWD = Traffic(people=(8, 10), drones=(4, 6), after_s=2.0)


NOBODY = Traffic(people=(0, 0), vehicles=(0, 0), drones=(0, 0))


def moving_recipe(traffic=CROWD, **tables):
    tables.setdefault("lidar", {"rows": 16, "columns": 60, "max_range_m": 12.0})
    return dataclasses.replace(small_recipe(**tables), parts={"movers": traffic})


@pytest.fixture(scope="module")
def drawn():
    """Samples, each with its world."""
    units = [drawn_unit(moving_recipe(), seed=seed) for seed in range(8)]
    return [(unit.world, sample) for unit in units for sample in unit.samples]


@pytest.fixture(scope="module")
def seen(drawn):
    """Those in whose maps movers are."""
    found = [pair for pair in drawn if (pair[1].voxel_mover >= 0).any()]
    assert len(found) >= 3
    return found


def test_worlds_and_flights_stay_without_movers():
    plain = drawn_unit(small_recipe(), seed=2)
    few = dataclasses.replace(NOBODY, people=(1, 1))
    moving = drawn_unit(moving_recipe(few), seed=2)
    assert_array_equal(plain.world.solids.position, moving.world.solids.position)
    assert plain.world.mjcf[:200] == moving.world.mjcf[:200]


def test_returns_lie_in_the_truth(drawn):
    grid = moving_recipe().grid
    for _, sample in drawn:
        assert not (sample.observed & ~sample.occupancy).any()
        index = grid.index(sample.points(), sample.origin)
        inside = ((index >= 0) & (index < grid.shape)).all(axis=1)
        hit = sample.return_mover[np.isfinite(sample.ranges)]
        moving = inside & (hit >= 0)
        # the voxel of a return from a mover is one that a mover touches
        assert (sample.voxel_mover[tuple(index[moving].T)] >= 0).all()


@pytest.mark.parametrize("after_s", [0.0, 0.5, 2.0])
def test_occupancy_later_is_the_worlds(seen, after_s):
    for world, sample in seen:
        (scan,) = sample.scans()
        later = truth_of(world, scan, moving_recipe(), float(sample.scan_times[0]) + after_s)
        assert_array_equal(sample.motion.occupancy(after_s), later["occupancy"])


def test_distances_now_are_those_stored(seen):
    for _, sample in seen:
        assert_array_equal(sample.motion.tudf(0.0), sample.tudf)


def test_flow_is_how_points_of_movers_go_on(seen):
    """By moving each voxel's centre with its mover for a thousandth of a second."""
    step_s, compared = 1e-3, 0
    for _, sample in seen:
        movers, now_s = sample.motion.movers, float(sample.scan_times[0])
        flow = sample.motion.flow()
        assert_array_equal(flow.any(axis=-1) & (sample.voxel_mover < 0), False)
        for index in np.argwhere(sample.voxel_mover >= 0)[:20]:
            m = int(sample.voxel_mover[tuple(index)])
            centre = sample.origin + (index + 0.5) * moving_recipe().grid.voxel_m
            speed = (moved(movers, m, centre, now_s, now_s + step_s) - centre) / step_s
            assert_allclose(flow[tuple(index)], speed, atol=0.02)
            compared += 1
    assert compared > 20


def moved(movers, m, point, begin_s, time_s):
    """Where a point of a mover is at a time, in the world."""
    frames = []
    for t in (begin_s, time_s):
        position, heading, _, _ = movers.poses(t)
        x, y = heading[m]
        frames.append((position[m], np.array([[x, -y, 0], [y, x, 0], [0, 0, 1]])))
    (place, turn), (next_place, next_turn) = frames
    return next_place + next_turn @ (turn.T @ (point - place))


def test_voxels_that_movers_pass(seen):
    """Those of all movers but one that stands now and then."""
    for _, sample in seen:
        motion, now_s = sample.motion, float(sample.scan_times[0])
        passed = np.zeros(sample.occupancy.shape, bool)
        poses = [motion.movers.poses(now_s + after_s) for after_s in (0.0, 1.0)]
        for m in range(len(motion.movers)):
            first, second = ([values[m] for values in pose] for pose in poses)
            if np.any(first[2]) or first[3] or not all(map(np.array_equal, first[:2], second)):
                passed |= (sample.voxel_mover == m) | (motion.voxels(1.0) == m)
        assert_array_equal(motion.passed(1.0), passed)
        assert_array_equal(motion.passed(0.0), motion.moving)


def test_times_beyond_the_table_are_refused(seen):
    refuses("later", seen[0][1].motion.occupancy, 2.5)


def test_a_sample_without_movers_says_so():
    refuses("none", lambda: drawn_unit(small_recipe(), seed=1).samples[0].motion)


@pytest.fixture(scope="module")
def moving(once):
    recipe = moving_recipe(mapping={"scans": 3})
    return once("moving_samples", lambda folder: dataset_in(folder / "d", recipe)) / "d"


def test_a_dataset_with_movers_passes_every_check(moving):
    assert failed(moving) == {}


def test_measures_count_movers(moving):
    for sample in scenegen.load(moving):
        hit = [number for number in sample.return_mover.ravel().tolist() if number >= 0]
        assert MEASURES["mover_returns"](sample) == len(hit)
        assert MEASURES["movers_seen"](sample) == len(set(hit))


@pytest.mark.parametrize(("scans", "firing"), [(1, False), (3, True)])
def test_with_firing_times_noise_and_scans_it_passes_too(tmp_path, scans, firing):
    traffic = dataclasses.replace(CROWD, firing_times=firing, drone_mps=(8.0, 12.0))
    recipe = moving_recipe(noise={"stages": "range:0.02"}, mapping={"scans": scans})
    lidar, parts = named_lidar("velodyne-vlp-16"), {"movers": traffic}
    recipe = dataclasses.replace(recipe, lidar=lidar, parts=parts)
    assert failed(dataset_in(tmp_path / "d", recipe).folder) == {}


def test_worlds_that_draw_no_mover_give_samples():
    (sample, *_) = drawn_unit(moving_recipe(NOBODY), seed=1).samples
    assert not sample.motion.flow().any()
    assert_array_equal(sample.motion.occupancy(1.0), sample.occupancy)


def test_an_engine_without_surfaces_says_so(tmp_path, capsys):
    words = "generate --kind pillar --movers light --engine mujoco --lidar ouster-os1-64"
    refuses_command(capsys, f"{words} --noise datasheet --n 1 --quiet -o {tmp_path}/d")


HOSTILE = {
    "a mover without pieces": ("mover_course", np.nan),
    "sizes that are not numbers": ("mover_solids", np.nan),
    "a mover beyond the table": ("voxel_mover", 127),
    "no movers": ("mover_kind", 0),
    "an unknown kind": ("mover_kind", 9),
    "times that are not numbers": ("scan_times", np.nan),
    "times beyond all flights": ("scan_times", 1e300),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_tables_are_found_and_harm_nobody(moving, tmp_path, case):
    name, value = HOSTILE[case]
    folder = forge.copy(moving, tmp_path / "d")
    forge.edit(folder, "train-00000.h5", lambda arrays: arrays[name].__setitem__(..., value))
    assert "examining it ended in" not in " ".join(failed(folder).values())
    for sample in scenegen.load(folder):
        for act in (lambda s: s.motion.flow(), lambda s: s.motion.occupancy(0.5)):
            with suppress(DatasetError):
                act(sample)


def test_archives_without_movers_are_named(moving, tmp_path, capsys):
    folder = forge.copy(moving, tmp_path / "d")

    def without_text(members):
        for name, mjcf in members.items():
            members[name] = mjcf.split(b"<custom><text")[0] + b"</mujoco>"

    for archive in folder.glob("*.worlds.zip"):
        forge.rezip(archive, without_text)
    assert failed(folder)
    refuses_command(capsys, f"generate --like {folder} --noise range:0.01 --quiet -o {tmp_path}/e")


CHANGES = {
    "return_mover": ("part-laws", lambda values: values.__setitem__(..., 23)),
    "voxel_mover": ("part-laws", lambda values: values.__setitem__(..., 0)),
    "static_occupancy": ("part-laws", lambda values: values.__setitem__(..., False)),
    "scan_times": ("rays", lambda values: values.__iadd__(1.5)),
    "scan_times alone": ("flights", lambda values: values.__iadd__(0.001)),
    "mover_course": ("parts", lambda values: values.__imul__(1.01)),
    "mover_solids": ("parts", lambda values: values.__imul__(1.01)),
    "mover_kind": ("parts", lambda values: values.__setitem__(values > 0, 2)),
    "course_end": ("parts", lambda values: values.__iadd__(1.0)),
}
"""The check that finds a change of each field, which is the first word, beside the digest."""


@pytest.mark.parametrize("name", CHANGES)
def test_a_change_of_a_field_is_found(moving, tmp_path, name):
    check, change = CHANGES[name]
    folder = forge.copy(moving, tmp_path / "d")
    forge.edit(folder, "train-00000.h5", lambda arrays: change(arrays[name.split()[0]]))
    assert {check, "digest"} <= failed(folder).keys()


def test_movers_of_a_dataset_are_scanned_again_to_the_bit(moving, tmp_path, capsys):
    done(capsys, f"generate --like {moving} --quiet -o {tmp_path}/again")
    first, second = (scenegen.load(folder)[0] for folder in (moving, tmp_path / "again"))
    assert first.sha256() == second.sha256()


@pytest.fixture(scope="module")
def labelled(once):
    parts = {"labels": labels_by("class", ()), "movers": CROWD}
    recipe = dataclasses.replace(moving_recipe(noise={"stages": "dropout:0.1"}), parts=parts)
    return once("moving_labels", lambda folder: dataset_in(folder / "d", recipe)) / "d"


def test_labels_name_the_kind_of_a_mover(labelled):
    samples, seen = scenegen.load(labelled), 0
    names = samples.dataset.manifest.parts["labels"].classes
    for sample in samples:
        kinds = np.append(sample.mover_kind, 0)
        for noun in ("return", "voxel"):
            mover, label = (getattr(sample, f"{noun}_{part}") for part in ("mover", "class"))
            for number, kind in enumerate(KINDS, start=1):
                own = (mover >= 0) & (kinds[mover] == number)
                assert_array_equal(label == names.index(kind), own)
                seen += np.count_nonzero(own)
    assert seen > 20


def test_labels_beside_movers_pass_every_check(labelled):
    assert failed(labelled) == {}


@pytest.mark.parametrize("name", ["voxel_class", "return_geom"])
def test_a_changed_label_of_a_mover_is_found(labelled, tmp_path, name):
    folder = forge.copy(labelled, tmp_path / "d")

    def change(arrays):
        moving = arrays[f"{name.split('_')[0]}_mover"][...] >= 0
        values = arrays[name][...]
        values[moving] -= 1
        arrays[name][...] = values

    forge.edit(folder, "train-00000.h5", change)
    assert "parts" in failed(folder)


SCENE = "generate --scene {} --n 3 --val 0 --test 0 --seed 1 --quiet --movers light -o {}"


@pytest.fixture(scope="module")
def from_file(once, tmp_path_factory):
    return (
        once("moving_scene", lambda folder: code_of(*SCENE.format(WAREHOUSE, folder / "d").split()))
        / "d"
    )


def test_worlds_from_files_have_movers(from_file):
    assert failed(from_file) == {}
    kinds = {int(kind) for sample in scenegen.load(from_file) for kind in sample.mover_kind}
    assert kinds == {0, 1, 3}


def test_a_written_world_keeps_its_movers(from_file, tmp_path, capsys):
    done(capsys, f"world {from_file} 0 -o {tmp_path}/w.xml")
    done(capsys, SCENE.format(f"{tmp_path}/w.xml", f"{tmp_path}/d"))
    for first, second in zip(scenegen.load(from_file), scenegen.load(tmp_path / "d"), strict=True):
        assert first.sha256() == second.sha256()


def test_a_world_with_movers_is_not_generated_without(from_file, tmp_path, capsys):
    done(capsys, f"world {from_file} 0 -o {tmp_path}/w.xml")
    refuses_command(capsys, f"generate --scene {tmp_path}/w.xml --n 1 -o {tmp_path}/d --quiet")


def test_maps_have_no_movers(tmp_path, capsys):
    hall = hall_in(tmp_path, np.full((40, 40, 20), 1, np.uint8))
    refuses_command(capsys, SCENE.format(hall, f"{tmp_path}/d"))
    refuses_command(capsys, f"scan {hall} --pose 1,1,1,0 --movers light --quiet")


def test_movers_that_find_no_room_are_named():
    crowded, world = dataclasses.replace(NOBODY, drones=(24, 24)), {"size_m": (6.0, 6.0, 3.0)}
    recipe = moving_recipe(crowded, accept={"max_draws": 2}, world=world)
    refuses("crowded", drawn_unit, recipe, seed=0)


def test_presets_of_movers_give_samples():
    recipe = dataclasses.replace(small_recipe("rooms"), parts={"movers": PRESETS["light"]})
    assert len(drawn_unit(recipe, seed=0).world.movers) >= 3


def recipe_with(tmp_path, table):
    file = tmp_path / "recipe.toml"
    file.write_text(f'kind = "pillar"\n[movers]\n{table}\n')
    return file


def test_a_recipes_table_sets_movers(tmp_path):
    traffic = read_recipe(recipe_with(tmp_path, "people = [1, 2]\nsensor_mps = 2.5")).traffic
    assert (traffic.people, traffic.sensor_mps) == ((1, 2), 2.5)


@pytest.mark.parametrize(
    "table",
    ["cats = 3", "people = [3, 1]", "person_mps = [0.5, 40.0]", "people = [20, 24]"],
)
def test_settings_out_of_bounds_are_refused(tmp_path, table):
    refuses(table, read_recipe, recipe_with(tmp_path, table))


def test_a_table_and_an_option_are_refused_together(tmp_path, capsys):
    file = recipe_with(tmp_path, "people = [1, 2]")
    refuses_command(capsys, f"generate --recipe {file} --n 1 --movers light -o {tmp_path}/d")
