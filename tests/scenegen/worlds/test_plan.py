"""ROS's plans become columns of voxels, cell by cell, and damaged ones end in a line."""

import json

import numpy as np
import pytest

from scenegen.draw.source import read_world
from scenegen.worlds.place import Place, read_place
from scenegen.worlds.plan import read_plan
from tests.command_line import beside, done, run
from tests.refusals import refuses
from tests.scenegen import cases, each_case

Image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")

SHADES = np.random.default_rng(0).choice([0, 88, 90, 205, 206, 254], (7, 11)).astype(np.uint8)
SHADES[[0, 6]] = SHADES[:, [0, 10]] = 205  # nothing known: cut off
YAML = beside(__file__, "nav2.yaml")


def write(folder, text=YAML, shades=SHADES):
    Image.fromarray(shades).save(folder / "plan.pgm")
    (folder / "plan.yaml").write_text(text)
    return folder / "plan.yaml"


def test_every_cell_is_what_its_shade_says(tmp_path):
    voxels = read_plan(write(tmp_path), 1.1).voxels
    # map_server: (255 - shade) / 255 above 0.65 is occupied, below 0.196 free
    states = np.select([SHADES <= 89, SHADES >= 206], [2, 1])
    # the first row is the farthest along y, and columns are along x
    known = np.argwhere(SHADES != 205)
    low, high = known.min(axis=0), known.max(axis=0) + 1
    expected = states[low[0] : high[0], low[1] : high[1]][::-1].T
    assert (voxels.states[:, :, 1:] == expected[..., None]).all()
    assert (voxels.states[:, :, 0] == np.where(expected, 2, 0)).all()
    corner = [-1.5 + 0.25 * low[1], 2.0 + 0.25 * (len(SHADES) - high[0]), -0.25]
    assert voxels.bounds[0] == pytest.approx(corner)
    assert voxels.states.shape[2] == 6


def test_what_a_saver_wrote_as_unknown_is_unknown(tmp_path):
    """Nav2's saver writes a free_thresh of 0.25 beside 205, which is then below it."""
    saved = np.where(SHADES < 200, 0, np.where(SHADES > 205, 254, 205)).astype(np.uint8)
    expected = read_plan(write(tmp_path, YAML, saved))
    plan = read_plan(write(tmp_path, YAML.replace("0.196", "0.25"), saved))
    assert (plan.voxels.states == expected.voxels.states).all()
    assert "shade 205 unknown" in plan.read
    # of all shades, or the other way round, thresholds alone count
    for negate, shades in ((0, SHADES), (1, 255 - SHADES)):
        text = YAML.replace("0.196", "0.25").replace("negate: 0", f"negate: {negate}")
        voxels = read_plan(write(tmp_path, text, shades)).voxels
        assert voxels.states.shape[:2] == SHADES.T.shape


@each_case("worlds/plan_spellings", "old new")
def test_other_spellings_are_the_same_map(old, new, tmp_path):
    Image.fromarray(SHADES).save(tmp_path / "plan.png")
    expected = read_plan(write(tmp_path)).voxels
    text = YAML.replace(old, new.replace("; ", "\n"))
    actual = read_plan(write(tmp_path, text, 255 - SHADES if "true" in new else SHADES)).voxels
    assert (actual.states == expected.states).all()
    assert (actual.origin == expected.origin).all()


def test_a_plan_is_a_world_of_a_height(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path)
    world = read_world("plan.yaml")
    assert isinstance(world, Place)
    assert world.voxels.bounds[1, 2] == pytest.approx(3)
    done(capsys, "map plan.yaml --height 2 -o plan.npz --quiet")
    assert read_place("plan.npz").voxels.bounds[1, 2] == pytest.approx(2)
    for words in ("plan.yaml --voxel 0.3", "plan.yaml plan.yaml", "a.ply --height 2"):
        code, _, error = run(capsys, f"map {words} -o other.npz")
        assert code == 2
        assert "is given alone, with --height" in " ".join(error.split())


PICTURES = {
    name: np.full(json.loads(shape), int(shade), np.uint8)
    for name, shape, shade in cases("worlds/plan_pictures")
}


@each_case("worlds/plan", "old new")
def test_a_damaged_plan_is_refused(tmp_path, old, new):
    text = YAML.replace("0.25", "1e-3") if new == "wide.pgm" else YAML
    path = write(tmp_path, text.replace(old, new))
    for name, shades in PICTURES.items():
        Image.fromarray(shades).save(tmp_path / name)
    (tmp_path / "huge.pgm").write_bytes(b"P5\n9999 9999\n255\n")
    (tmp_path / "cut.pgm").write_bytes((tmp_path / "plan.pgm").read_bytes()[:40])
    refuses(f"{old} {new}", read_world, path)
