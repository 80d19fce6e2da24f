"""`scenegen generate` as users meet it, with what `inspect` and `world` make of its datasets."""

import json
from pathlib import Path

import msgspec
import mujoco

from scenegen.cli.options import find_datasets
from scenegen.dataset import manifest
from scenegen.dataset.read import Dataset
from tests.command_line import SMALL, done, example, run
from tests.refusals import refuses_command
from tests.scenegen import each_case


def test_generate_inspect_and_world_work_together(small, tmp_path, capsys):
    out = tmp_path / "d"
    command = f"generate --recipe {small} --n 12 --out {out} --workers 1"
    summary, digest = done(capsys, command), Dataset(out).manifest.digest
    assert digest in summary
    assert f"scenegen inspect {out}" in summary
    assert json.loads(done(capsys, f"{command} --json"))["complete"]
    done(capsys, f"{command} --quiet")
    report = json.loads(done(capsys, f"inspect {out} --json"))
    assert [split["samples"] for split in report["splits"].values()] == [12, 1, 2]
    assert report["digest"] == digest
    assert "12 samples of 4 worlds" in done(capsys, f"inspect {out} --details")
    refuses_command(capsys, f"world {out} 3 -o {tmp_path}/world.usd")
    done(capsys, f"world {out} 3 --split train -o {tmp_path}/world.xml")
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "world.xml")).ngeom > 0


def test_an_engine_and_a_sensor_are_taken_by_name(small, tmp_path, capsys):
    small.write_text(SMALL.replace("[lidar]\nrows = 8\ncolumns = 24\n", ""))
    out = tmp_path / "d"
    command = f"generate --recipe {small} --n 3 --val 0 --test 0 --workers 1 --out {out}"
    asked = done(capsys, f"{command} --lidar ouster-os1-128 --dry-run --json")
    assert json.loads(asked)["bytes_expected"] > 700_000  # 3 scans of 131,072 rays
    assert not out.exists()
    done(capsys, f"{command} --quiet --engine mujoco --sensor raster")
    assert Dataset(out).manifest.engine == "mujoco"
    refuses_command(capsys, command)


@each_case("cli/generate_bad_use", "words")
def test_bad_use_ends_in_one_line(words, tmp_path, capsys):
    (tmp_path / "s.py").touch()
    words = words.replace("HERE", str(tmp_path))
    refuses_command(capsys, f"generate {words} --out {tmp_path}/d --quiet")
    assert not (tmp_path / "d").exists()


@each_case("cli/generate_bad_scenes", "document")
def test_a_bad_scene_ends_in_one_line(document, tmp_path, capfd):
    (tmp_path / "s.xml").write_text(document)
    command = f"generate --scene {tmp_path}/s.xml --n 5 --out {tmp_path}/d --quiet"
    refuses_command(capfd, command, document)


def test_what_a_scene_leaves_out_is_said_once(tmp_path, capfd):
    body = '<body><joint name="j"/><geom size="1"/></body><geom size="1" pos="9 9 2"/>'
    (tmp_path / "s.xml").write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    words = ("generate", "--scene", tmp_path / "s.xml", "--n", 5, "--dry-run")
    assert run(capfd, *words)[2].count("s.xml: joints (1) stay in their reference position") == 1
    assert run(capfd, *words, "--quiet")[2] == ""


def test_a_dry_run_prints_a_recipe_file_that_asks_for_the_same(small, tmp_path, capsys):
    command, pasted = f"generate -n 6 --out {tmp_path}/d --dry-run --recipe", tmp_path / "it.toml"
    said = done(capsys, f"{command} {small}")
    pasted.write_text(said[said.index("# this") :])
    first, second = (done(capsys, f"{command} {path} --json") for path in (small, pasted))
    assert first == second


def test_a_world_of_ones_own_as_the_docs_show_it(tmp_path, capsys):
    (tmp_path / "yard.xml").write_text(example("own-worlds.md", 'model="yard"'))
    command = f"generate --scene {tmp_path}/yard.xml --n 2 --workers 1 --out {tmp_path}/d"
    done(capsys, f"{command} --quiet")
    assert len(Dataset(tmp_path / "d").split("train")) == 2
    assert "nothing was left to make" in done(capsys, command)


def test_folders_under_data_without_samples_are_left_out(made, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    full, begun = Path("data/full"), Path("data/begun")
    begun.mkdir(parents=True)
    full.symlink_to(made)
    empty = {"shards": (), "complete": False, "digest": None}
    manifest.write(begun, msgspec.structs.replace(manifest.load(made), **empty))
    assert [dataset.name for dataset in find_datasets((), show_progress=True)] == [str(full)]
    assert capsys.readouterr().err == "data/begun: holds no samples yet, so it is left out\n"
