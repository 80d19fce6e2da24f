"""`scenegen sensors`, `scenegen scan` and `generate --lidar`: what they tell, write and refuse."""

import json

import matplotlib.image
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import scenegen
from lidarsim import BeamTable
from lidarsim.engines.voxels import FREE, OCCUPIED, UNKNOWN
from lidarsim.sensors import CATALOGUE
from scenegen.dataset.read import Dataset
from scenegen.view.stills import draw_patterns
from tests.command_line import ROOT, SMALL, beside, done
from tests.refusals import refuses_command
from tests.scenegen import each_case
from tests.scenegen.worlds.test_octomap import written

AT = "scan room.xml --pose 1,2,0.5,30"
LIDAR = beside(__file__, "mine.toml")


FILES = {
    "room.xml": beside(__file__, "room.xml"),
    "mine.toml": LIDAR,
    "small.toml": SMALL,
    "bare.toml": (BARE := SMALL.replace("[lidar]\nrows = 8\ncolumns = 24\n", "")),
    "arm.toml": f"{BARE}[lidar]\n{LIDAR}lever_arm_m = [0, 0, 0.3]",
    "held.toml": f"{LIDAR}lever_arm_m = [0, 0, 0.3]",
    "taken.toml": LIDAR.replace('"mine"', '"livox-avia"'),
    "nameless.toml": LIDAR.replace('sensor = "spinning"', ""),
    "family.toml": LIDAR.replace('"mine"', '"spinning"'),
}


@pytest.fixture
def here(standing):
    """A folder to stand in, with a room 20 m wide, recipes and sensors."""
    for name, text in FILES.items():
        (standing / name).write_text(text)
    return standing


def test_the_list_has_every_sensor_and_a_file_is_told_of(here, capsys, monkeypatch):
    some = "velodyne-vlp-16", "livox-mid-360"
    monkeypatch.setattr("scenegen.cli.scan.CATALOGUE", some)
    lines = done(capsys, "sensors").splitlines()
    assert {line.split(" ")[0] for line in lines} >= {"raster", *some}
    listed = json.loads(done(capsys, "sensors mine.toml ouster-os1-128 --json --out p.png"))
    assert listed["ouster-os1-128"]["elevation_deg"] == [-21.82, 20.95]
    told = listed["mine.toml"]
    assert told["shape"] == [2, 8]
    assert told["elevation_deg"] == [-5.0, 5.0]
    assert matplotlib.image.imread(here / "p.png").shape[1] == 640


def test_a_pattern_has_a_dot_where_a_ray_points():
    turned = Rotation.from_euler("ZY", [-35, -20], degrees=True)
    rays = np.array([[1.0, 0, 0, 0.0], [*turned.apply([1.0, 0, 0]), 0.1]])
    figure = draw_patterns({"mine": BeamTable(rays=rays)})
    (panel,) = figure.axes
    (dots,) = panel.collections
    assert_allclose(dots.get_offsets(), [[0, 0], [-35, 20]], atol=1e-9)
    assert dots.get_array().argmax() == 1  # the last in time
    assert np.greater(*panel.get_xlim())  # left of the body to the left


def test_the_docs_have_the_pattern_of_every_sensor():
    there = (ROOT / "docs" / "pictures" / "sensors").glob("*.png")
    assert {path.stem for path in there if path.stat().st_size < 60_000} >= set(CATALOGUE)


def test_a_dataset_by_a_sensors_name_says_what_made_it(here, capsys):
    command = "generate -n 3 --val 0 --test 0 --quiet --workers 1 --recipe"
    name = "robosense-helios-16p"
    (here / "in.toml").write_text(f'{BARE}[lidar]\nsensor = "{name}"\nmax_range_m = 20')
    cases = {f"bare.toml --lidar {name}": name, "in.toml": f"{name}(max_range_m=20.0)"}
    for words, made_by in cases.items():
        done(capsys, f"{command} {words} --out {len(words)}")
        lidar = Dataset(here / f"{len(words)}").manifest.tables.lidar
        assert (lidar["made_by"], lidar["shape"]) == (made_by, [16, 1800])


def test_a_scan_without_noise_lies_on_the_walls_and_with_it_near_them(here, capsys):
    at, noise = f"{AT} --lidar mine.toml --frame world --json -o", "--noise datasheet,intensity"
    assert json.loads(done(capsys, f"{at} clean.npz"))["returns"] == 16
    for name in ("noisy.npz", "again.npz", "noisy.bin"):
        done(capsys, f"{at} {name} {noise}")
    clean, noisy = (np.load(here / f"{name}.npz") for name in ("clean", "noisy"))
    walls, near = (np.abs(scan["points"][:, :2]).max(axis=1) - 10.0 for scan in (clean, noisy))
    assert_allclose(walls, 0.0, atol=1e-5)
    assert 0.001 < np.abs(near).max() < 0.08
    assert ((noisy["intensity"] > 0.3) & (noisy["intensity"] <= 1)).all()
    assert (here / "again.npz").read_bytes() == (here / "noisy.npz").read_bytes()
    rows = np.fromfile(here / "noisy.bin", "<f4").reshape(-1, 4)  # as KITTI has them
    assert_allclose(rows, np.column_stack([noisy["points"], noisy["intensity"]]), rtol=1e-6)
    done(capsys, f"{AT} --lidar held.toml --frame world -o held.pcd")
    assert b"VIEWPOINT 1.0 2.0 0.8 1" in (here / "held.pcd").read_bytes()


def test_a_scan_in_flight_is_at_the_seeds_place(here, capsys):
    def place(seed):
        said = done(capsys, f"scan room.xml --flight --seed {seed} --json")
        return json.loads(said)["position"]

    assert place(1) == place(1) != place(2)


def test_poses_in_a_flight_follow_one_another(here):
    poses = scenegen.poses_in_flight(scenegen.read_world("room.xml"), seed=2, every_m=0.5)
    steps = np.linalg.norm(np.diff([pose.position for pose in poses], axis=0), axis=1)
    assert len(steps) > 3
    assert steps.max() <= 0.5 + 1e-9
    assert np.median(steps) > 0.49


@each_case("cli/sensors", "words")
def test_what_cannot_be_ends_in_one_line(words, here, capsys):
    before = set(here.iterdir())
    refuses_command(capsys, words)
    assert set(here.iterdir()) == before


def test_a_map_of_a_real_place_is_scanned_and_inspected(standing, capsys):
    """A room of 4 × 4 × 2 m, mapped at 0.1 m; beyond its walls, and behind one of its halves,
    nothing is known."""
    states, room = np.full((40, 40, 20), OCCUPIED, np.uint8), standing / "room.bt"
    states[1:-1, 1:-1, 1:-1] = FREE
    states[30:-1, 20:-1, 1:-1] = UNKNOWN
    room.write_bytes(written(states, (0, 0, 0), ".bt"))
    facts = json.loads(done(capsys, "inspect room.bt --json"))
    assert facts["bounds"] == [[0, 0, 0], pytest.approx([4, 4, 2])]
    assert facts["unknown"] == pytest.approx((states == UNKNOWN).mean())
    scan = "scan room.bt --pose 1,2,1,0"
    row = json.loads(done(capsys, f"{scan} --lidar velodyne-vlp-16 --frame world -o a.npz --json"))
    assert row["returns"] == row["rays"]  # the room is closed
    index = np.floor(np.load("a.npz")["points"] / 0.1 + 1e-6).astype(int)
    assert (states[tuple(index.T)] == OCCUPIED).all()
    assert 0 < row["rays_through_unknown"] < row["rays"] / 2
    for words in ("--engine mujoco", "--noise intensity"):
        refuses_command(capsys, f"{scan} {words}")
