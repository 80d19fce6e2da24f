"""The command line as users meet it: what it makes, what it prints, and how it ends."""

import json
import os
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import mujoco
import pytest

from scenegen import __main__ as cli
from scenegen import __version__
from scenegen.dataset.read import Dataset

SMALL = """
kind = "pillar"
[world]
size_m = [16, 16, 8]
[flight]
viewpoints = 3
margin_m = 2
min_distance_m = 4
[accept]
min_solids = 1
[lidar]
rows = 8
columns = 24
[grid]
shape = [24, 24, 16]
"""
BOX = '<mujoco><worldbody><geom name="{name}" type="box" size="1 1 1" pos="{x} 0 0" {more}/></worldbody></mujoco>'


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """A recipe file for a small dataset."""
    path = tmp_path / "small.toml"
    path.write_text(SMALL)
    return path


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a command."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["scenegen", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
    said = capsys.readouterr()
    return int(ended.value.code or 0), said.out, said.err


def test_generate_inspect_and_world_work_together(
    small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "d"
    code, said, _ = run(capsys, "generate", "--recipe", small, "--n", 12, "--out", out, "--workers", 1)
    assert code == 0
    digest = Dataset(out).manifest.digest
    assert digest in said
    assert f"scenegen inspect {out}" in said
    code, said, _ = run(capsys, "inspect", out, "--json")
    found = json.loads(said)
    assert {name: split["samples"] for name, split in found["splits"].items()} == {"train": 12, "val": 1, "test": 2}
    assert found["digest"] == digest
    assert 0 < found["splits"]["train"]["statistics"]["occupied"]["mean"] < 0.5
    code, _, error = run(capsys, "world", out, 3, "-o", tmp_path)
    assert code == 2
    assert "is not a regular file" in error
    code, said, _ = run(capsys, "inspect", out)
    assert code == 0
    assert "12 samples of 4 worlds" in said
    code, _, _ = run(capsys, "world", out, 3, "--split", "train", "-o", tmp_path / "world.xml")
    assert code == 0
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "world.xml")).ngeom > 0


def test_json_and_quiet_and_dry_run_print_what_they_say(
    small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("generate", "--recipe", small, "--n", 6, "--workers", 1, "--out", tmp_path / "d")
    code, said, _ = run(capsys, *words, "--dry-run", "--json")
    assert code == 0
    assert json.loads(said)["samples"] == 8
    assert not (tmp_path / "d").exists()
    code, said, _error = run(capsys, *words, "--json")
    assert json.loads(said)["complete"]
    assert run(capsys, *words, "--quiet") == (0, "", "")


def test_a_split_range_makes_its_shards_alone(small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("generate", "--recipe", small, "--n", 9, "--shard-samples", 3, "--out", tmp_path / "d", "--json")
    said = json.loads(run(capsys, *words, "--split-range", "1:3")[1])
    assert (said["complete"], said["samples_written"], said["shards_missing"]) == (False, 6, 3)
    said = json.loads(run(capsys, *words)[1])
    assert (said["complete"], said["samples_written"]) == (True, 5)


def test_a_scene_gives_training_samples_of_one_world(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recipe = tmp_path / "r.toml"
    recipe.write_text(
        SMALL.replace('kind = "pillar"', "").split("[world]")[0] + "[flight]" + SMALL.split("[flight]")[1]
    )
    room = Path(__file__).parents[1] / "scenes" / "room_with_gap.xml"
    code, said, error = run(
        capsys, "generate", "--scene", room, "--recipe", recipe, "--n", 7, "--out", tmp_path / "d", "--json"
    )
    assert (code, error) == (0, "")
    assert json.loads(said)["samples"] == {"train": 7, "val": 0, "test": 0}
    assert Dataset(tmp_path / "d").split("train").names == [("train", 0, n) for n in range(7)]


BAD_USE = {
    "an unknown kind": (("--kind", "piller"), "did you mean 'pillar'?"),
    "no kind": ((), "give --kind, --scene or --recipe"),
    "a negative count": (("--kind", "pillar", "--n", "-5"), "-5"),
    "a count of zero": (("--kind", "pillar", "--n", "0"), "--n"),
    "no workers": (("--kind", "pillar", "--workers", "0"), "--workers"),
    "kind and scene": (("--kind", "pillar", "--scene", "x.xml"), "give one of the two"),
    "a backward range": (("--kind", "pillar", "--split-range", "5:2"), "FIRST:STOP"),
    "a range too far": (("--kind", "pillar", "--n", "10", "--split-range", "0:99"), "there are 3 shards"),
    "an unknown option": (("--kin", "pillar"), "--kind"),
    "no end of workers": (("--kind", "pillar", "--workers", str(10**9)), "--workers"),
    "no end of shards": (("--kind", "pillar", "--split-range", f"0:{10**30}"), "shards"),
    "a range of thousands of digits": (("--kind", "pillar", "--split-range", f"0:{'9' * 5000}"), "FIRST:STOP"),
}


@pytest.mark.parametrize("what", BAD_USE)
def test_bad_use_ends_in_one_line(what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words, named = BAD_USE[what]
    code, said, error = run(capsys, "generate", *words, "--out", tmp_path / "d", "--quiet")
    assert code == 2
    assert named in error
    assert error.count("\n") == 1
    assert said == ""
    assert not (tmp_path / "d").exists()


BAD_RECIPES = {
    "unknown parameter": (
        "[world]\ndensty = [0.1, 0.2]",
        "[world]: unknown parameter 'densty'; did you mean 'density'?",
    ),
    "unknown table": ("[wrld]\ndensity = [0.1, 0.2]", "unknown table 'wrld'"),
    "falling range": ("[world]\ndensity = [0.3, 0.2]", "expected [low, high]"),
    "wrong type": ("[flight]\nviewpoints = 'five'", "viewpoints = 'five'"),
    "share above one": ("[world]\nround_share = 1.5", "round_share = 1.5: expected a finite number from 0 to 1"),
    "no room": ("[flight]\nmargin_m = 30.0", "margin_m = 30"),
    "no grid": ("[grid]\nshape = [80, 0, 40]", "shape"),
    "no rays": ("[lidar]\nrows = 0", "rows"),
    "sizes of nothing": (
        "[world]\nhalf_width_m = [0, 0]",
        "half_width_m = [0, 0]: expected [low, high] with low <= high, finite numbers above 0",
    ),
    "ratio below one": ("[world]\noblong_ratio = 0.5", "oblong_ratio = 0.5"),
    "shares above one": ("[world]\nround_share = 0.8\noblong_share = 0.5", "expected at most 1"),
    "an endless density": ("[world]\ndensity = [0.1, inf]", "density = [0.1, inf]: expected"),
    "an endless spacing": ("[flight]\nspacing_m = inf", "spacing_m = inf"),
    "an endless height": ("[flight]\naltitude_m = [2, inf]", "altitude_m = [2, inf]: expected"),
    "too many": ("[world]\ndensity = [90, 90]", "expected 20000 at most"),
    "words for numbers": ("[flight]\nviewpoints = '5'", "viewpoints = '5'"),
    "truth for numbers": ("[flight]\nviewpoints = true", "viewpoints = True"),
    "a million lines": ("[lidar]\nrows = 100000000", "rows = 100000000: expected a whole number from 1 to 1000000"),
    "no end of distance": ("[grid]\ntruncation_m = 1e9", "truncation_m = 1000000000.0"),
    "no table": ("world = 3", "expected a table"),
    "not a number": ("[world]\ndensity = [nan, 0.1]", "density = [nan, 0.1]: expected"),
    "wrong kind": ('kind = "geometric"', "is a recipe for kind 'geometric'"),
    "not TOML": ("density = = 3", "not valid TOML"),
    "two edges": ("[grid]\nshape = [80, 80]", "three whole numbers from 1 to 8192, such as [80, 80, 40]"),
    "a date": ("[grid]\nshape = 1979-05-27", "shape = datetime.date(1979, 5, 27): expected three whole numbers"),
    "nested edges": ("[grid]\nshape = [[1], 2, 3]", "shape = [[1], 2, 3]: expected three whole numbers"),
    "true edges": ("[grid]\nshape = [true, true, true]", "expected three whole numbers"),
    "an unknown mount": ("[lidar]\nmount = 'gimbal'", "mount = 'gimbal': expected 'tilt' or 'band'"),
    "text for truth": ("[world]\nground = 'yes'", "ground = 'yes': expected true or false"),
    "a key that prints": ('[world]\n"\\u001b[2Jall\\nright" = 1', "unknown parameter '\\x1b[2Jall\\nright'"),
    "an empty kind": ('kind = ""', "is a recipe for kind '', not for 'pillar'"),
    "a kind of numbers": ("kind = [1]", "is a recipe for kind [1], not for 'pillar'"),
    "no end of digits": (f"[grid]\nvoxel_m = 0x{'f' * 9000}", "voxel_m = a value of type int"),
    "more digits than int takes": (f"[grid]\nvoxel_m = {'9' * 9000}", "not valid TOML"),
    "deep arrays": (f"[grid]\nshape = {'[' * 5000}{']' * 5000}", "nested too deeply"),
    "deep keys": (f"{'a.' * 30_000}a = 1", "nested too deeply"),
    "too large": (f"kind = 'pillar' # {'x' * (1 << 16)}", "bytes, expected 65536 at most"),
    "no end of places": ("[flight]\nspacing_m = 1e-7", "spacing_m = 1e-07: expected"),
    "as good as no spacing": ("[flight]\nspacing_m = 1e-300", "spacing_m = 1e-300: expected"),
    "a million places": ("[flight]\nspacing_m = 0.001", "places to scan from along one flight"),
    "no end of draws": ("[accept]\nmax_draws = 1000000000", "max_draws = 1000000000: expected"),
    "draws of flights of searches": (
        "[accept]\nmax_draws = 10000\n[flight]\nflights_per_world = 1000\niterations = 1000000",
        "expected 1000000000 at most; lower one of them",
    ),
    "maps beyond what is read": ("[grid]\nshape = [408, 408, 408]", "67917312 voxels, expected 67108864 at most"),
    "maps beyond memory": ("[grid]\nshape = [400, 400, 400]\n[flight]\nviewpoints = 17", "expected 16 at most"),
    "voxels beyond the rays": ("[grid]\nvoxel_m = 90.0\ntruncation_m = 90.0", "voxel_m = 90.0: expected at most the"),
    "a world as wide as a country": ("[world]\nsize_m = [1e6, 1e6, 10]\ndensity = [0, 0]", "size_m = [1000000.0, 10"),
    "too dense": ("[world]\ndensity = [4.0, 4.0]\n[accept]\nmax_draws = 2", "lower world.density = (4.0, 4.0)"),
}


@pytest.mark.parametrize("what", BAD_RECIPES)
def test_a_bad_recipe_ends_in_one_line(what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text, named = BAD_RECIPES[what]
    (tmp_path / "r.toml").write_text(text)
    words = ("--kind", "pillar", "--recipe", tmp_path / "r.toml", "--n", 5, "--out", tmp_path / "d", "--quiet")
    code, said, error = run(capsys, "generate", *words)
    assert code == 1
    assert named in error
    assert error.count("\n") == 1
    assert said == ""


def test_a_recipe_that_is_no_file_ends_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    os.mkfifo(tmp_path / "pipe.toml")
    for path, named in (("pipe.toml", "not a regular file"), ("", "not a regular file"), ("gone.toml", "no such file")):
        code, said, error = run(capsys, "generate", "--recipe", tmp_path / path, "--out", tmp_path / "d", "--quiet")
        assert (code, said, error.count("\n")) == (1, "", 1)
        assert named in error


def test_a_grid_that_the_network_cannot_take_is_mentioned(
    small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("generate", "--n", 3, "--out", tmp_path / "d", "--dry-run", "--recipe")
    (tmp_path / "odd.toml").write_text(SMALL.replace("24, 24, 16", "24, 20, 16"))
    assert "multiples of 8" not in run(capsys, *words, small)[2]
    assert (
        "edges that are multiples of 8, and grid.shape = [24, 20, 16]" in run(capsys, *words, tmp_path / "odd.toml")[2]
    )
    for silent in ("--quiet", "--json"):
        assert run(capsys, *words, tmp_path / "odd.toml", silent)[2] == ""


def test_the_recipe_in_the_documentation_makes_maps_that_the_network_takes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (Path(__file__).parents[1] / "docs" / "recipes.md").read_text().split("```toml\n")[1].split("```")[0]
    (tmp_path / "r.toml").write_text(text)
    code, _, error = run(capsys, "generate", "--recipe", tmp_path / "r.toml", "--out", tmp_path / "d", "--dry-run")
    assert code == 0
    assert "multiples" not in error


BAD_SCENES = {
    "not XML": ("<mujoco><worldbody>", "not valid MJCF"),
    "no geometry": ("<mujoco/>", "no geom that rays can see"),
    "all invisible": (BOX.format(name="a", x=0, more='rgba="1 1 1 0"'), "no geom that rays can see"),
    "one invisible": (
        BOX.format(name="ghost", x=9, more='rgba="1 1 1 0"').replace("</w", '<geom size="1"/></w'),
        "cannot see geom ghost",
    ),
    "only a plane": ('<mujoco><worldbody><geom type="plane" size="1 1 1"/></worldbody></mujoco>', "flight_bounds"),
    "no room to fly": (BOX.format(name="a", x=0, more=""), "no flight fits between the solids"),
    "far away": (
        "<mujoco><worldbody>" + '<geom size="1" pos="5000000 0 0"/>' * 2 + "</worldbody></mujoco>",
        "'5000000', expected numbers up to 1e+06",
    ),
    "missing mesh": ('<mujoco><asset><mesh name="m" file="gone.obj"/></asset></mujoco>', "gone.obj"),
}


@pytest.mark.parametrize("what", BAD_SCENES)
def test_a_bad_scene_ends_in_one_line(what: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    document, named = BAD_SCENES[what]
    (tmp_path / "s.xml").write_text(document)
    words = ("--scene", tmp_path / "s.xml", "--n", 5, "--out", tmp_path / "d", "--quiet")
    code, said, error = run(capfd, "generate", *words)
    assert code == 1
    assert named in error
    assert error.count("\n") == 1
    assert said == ""


def test_what_a_scene_leaves_out_is_said_once(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    body = '<body><joint name="j"/><geom size="1"/></body><geom size="1" pos="9 9 2"/>'
    (tmp_path / "s.xml").write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    words = ("generate", "--scene", tmp_path / "s.xml", "--n", 5, "--out", tmp_path / "d", "--dry-run")
    assert run(capfd, *words)[2].count("s.xml: joints (1) stay in their reference position") == 1
    assert run(capfd, *words, "--quiet")[2] == ""


def test_a_scene_recipe_needs_its_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "r.toml").write_text('kind = "scene"')
    code, _, error = run(capsys, "generate", "--recipe", tmp_path / "r.toml")
    assert code == 2
    assert "give --scene" in error


def test_an_unwritable_folder_ends_in_one_line(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, error = run(capsys, "generate", "--recipe", small, "--n", 3, "--out", "/proc/nowhere/d", "--quiet")
    assert code == 1
    assert "choose another place" in error
    assert error.count("\n") == 1


def test_version_completion_and_doctor(capsys: pytest.CaptureFixture[str]) -> None:
    assert __version__ in run(capsys, "--version")[1]
    assert "_SCENEGEN_COMPLETE" in run(capsys, "completion", "bash")[1]
    code, said, _ = run(capsys, "doctor", "--json")
    found = json.loads(said)
    assert code == 0
    assert found["ok"]
    assert found["self_test"]["returns_occupied"]
    assert found["self_test"]["repeatable"]
    assert found["software"]["mujoco"] == mujoco.__version__


def start(small: Path, out: Path) -> subprocess.Popen[str]:
    """A run with workers that lasts until it is stopped, well under way."""
    command = [sys.executable, "-m", "cli", "generate", "--recipe", str(small), "--n", "200000", "--out", str(out)]
    process = subprocess.Popen(
        [*command, "--workers", "2", "--shard-samples", "30"],
        cwd=Path(__file__).parents[1],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    deadline = time.monotonic() + 150  # with nothing cached, kernels compile first
    while len(list(out.glob("*.h5"))) < 3:
        assert process.poll() is None, process.stderr.read() if process.stderr else ""
        assert time.monotonic() < deadline, "no shard was written"
        time.sleep(0.05)
    return process


def descendants(pid: int) -> list[int]:
    """Processes of the session that `pid` leads, itself left out."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            fields = (entry / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == pid and int(entry.name) != pid and fields[0] != "Z":
            found.append(int(entry.name))
    return found


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_stopped_run_leaves_no_process_and_whole_files(number: int, small: Path, tmp_path: Path) -> None:
    out = tmp_path / "d"
    process = start(small, out)
    assert len(descendants(process.pid)) >= 2
    os.killpg(process.pid, number) if number == signal.SIGINT else process.send_signal(number)
    _, error = process.communicate(timeout=20)
    deadline = time.monotonic() + 10
    while descendants(process.pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert descendants(process.pid) == []
    if number != signal.SIGKILL:
        assert process.returncode == 130
        assert "nothing finished is lost" in error
        assert "Traceback" not in error
        assert not list(out.glob(".*.tmp"))
    for path in out.glob("*.h5"):
        assert path.with_suffix(".worlds.zip").exists()


def test_the_first_run_says_why_it_takes_longer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from lidarsim import jit

    for cached, said in ((tmp_path / "empty", True), (jit.cache_folder("scenegen"), False)):
        monkeypatch.setattr(jit, "cache_folder", lambda package, cached=cached: cached)
        assert ("compiling kernels" in run(capsys, "generate", "--kind", "pillar", "--dry-run")[2]) == said


def test_help_loads_nothing_heavy() -> None:
    heavy = "mujoco", "numba", "h5py", "ompl", "scipy", "numpy"
    code = f"import sys, cli; sys.exit(', '.join(name for name in {heavy!r} if name in sys.modules) or 0)"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=Path(__file__).parents[1], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_printing_in_vain_changes_no_verdict(small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Output that is lost is told and ends with 1; nobody need read standard error, nor all of the output."""
    out = tmp_path / "d"
    assert run(capsys, "generate", "--recipe", small, "--n", 3, "--out", out, "--workers", 1, "--quiet")[0] == 0
    verify = f"{sys.executable} cli.py verify --quick {out}"
    script = f"{sys.executable} cli.py completion bash"
    lost = "scenegen: standard output: {}; what was to be printed is lost\n".format
    expected = {
        f"{verify} 2>/dev/full >/dev/null": (0, ""),
        f"{script} >&-": (1, lost("Bad file descriptor")),
        f"{script} >/dev/full": (1, lost("No space left on device")),
        f"({script}; echo $? >&2) | true": (0, "0\n"),
    }
    root = Path(__file__).parents[1]
    running = [subprocess.Popen(words, shell=True, cwd=root, stderr=subprocess.PIPE, text=True) for words in expected]
    for process, (command, (code, error)) in zip(running, expected.items(), strict=True):
        assert (process.communicate(timeout=120)[1], process.returncode) == (error, code), command


def test_names_from_files_print_no_lines_of_their_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    forged = "x\nscenegen: verify: all 17 checks passed\x1b[32m"
    (tmp_path / forged).mkdir()
    (tmp_path / forged / "dataset.json").write_text(json.dumps({"format": forged}))
    for words in (("inspect", tmp_path / forged), ("verify", tmp_path / forged), ("train", "--variant", forged)):
        code, said, error = run(capsys, *words)
        assert code
        for line in (said + error).splitlines():
            assert line.isprintable()
            assert not line.startswith("scenegen: verify: all")


def test_warnings_of_libraries_reach_nobody(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    def warn() -> dict[str, Any]:
        warnings.warn("settotalmass is deprecated", stacklevel=1)
        return {"ok": True}

    monkeypatch.setattr("scenegen.doctor.examine", warn)
    assert run(capfd, "doctor", "--json") == (0, '{"ok": true}\n', "")


def test_folders_under_data_without_samples_are_left_out(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from scenegen.dataset import manifest

    monkeypatch.chdir(tmp_path)
    assert run(capsys, "generate", "--recipe", small, "--n", 3, "--workers", 1, "--quiet")[0] == 0
    empty = manifest.read(Path("data/pillar"))
    Path("data/begun").mkdir()
    manifest.write(Path("data/begun"), {**empty, "shards": [], "complete": False, "digest": None})
    assert cli._found((), shown=True) == (Path("data/pillar"),)
    assert capsys.readouterr().err == "data/begun: holds no samples yet, so it is left out\n"
