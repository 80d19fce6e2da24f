"""A path is recognised by its name, its files and its first bytes; what is unknown is refused."""

import json
import zipfile

import pytest

from lidarsim.registry import Registry
from scenegen.base.errors import DatasetError
from scenegen.base.paths import SCANS, TYPES, check_type, open_path, type_of, what_is
from scenegen.worlds.clouds import READERS
from tests.command_line import refused

FILES = {
    "a/dataset.json": "",
    "mixed/collection.json": "",
    "few.json": '{"format": "scenegen-selection"',
    "predicted/predictions.json": "",
    "run/metrics.csv": "",
    "drive/poses.txt": "",
    "bag/metadata.yaml": "",
    "sequences/07/velodyne/000000.bin": "",
    "poses/07.txt": "",
    "recorded/one.db3": "",
    "clouds/deep/1.ply": "",
    "flights.json": '{"format": 1, "scenegen": "0.2.0"}',
    "other.json": "{}",
    "notes.txt": "",
    "none": "",
    "broken.npz": "PK",
}
EXPECTED = {
    ".": "datasets",
    "a": "dataset",
    "mixed": "collection",
    "few.json": "selection",
    "predicted": "predictions",
    "done.h5": "predictions",
    "run": "run",
    "drive": "log",
    "bag": "log",
    "sequences/07": "log",
    "recorded": "log",
    "x.mcap": "log",
    "clouds": "scans",
    "campus.bt": "map",
    "hall.npz": "map",
    "broken.npz": "scan",
    "scan.pcd.bin": "scan",
    "SCAN.PLY": "scan",
    "forest.xml": "world",
    "chair.glb": "mesh",
    "lab.yaml": "plan",
    "net.safetensors": "weights",
    "flights.json": "flights",
    "rooms.toml": "recipe",
    "hf://ada/pillar": "dataset",
    "s3://bucket/folder": "dataset",
}


@pytest.fixture
def here(tmp_path):
    for name, text in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    with zipfile.ZipFile(tmp_path / "hall.npz", "w") as archive:
        archive.writestr("states.npy", b"")
    return tmp_path


@pytest.mark.parametrize(("name", "expected"), EXPECTED.items())
def test_paths_are_recognised(here, name, expected):
    assert what_is(name if "://" in name else here / name) == expected


def test_every_type_is_recognised_and_opened_by_a_function_that_there_is():
    assert {*EXPECTED.values()} == TYPES.keys()
    for verb in ("opens", "facts", "draws", "shows"):
        functions = {name: getattr(path_type, verb) for name, path_type in TYPES.items()}
        registry = Registry("path", {name: place for name, place in functions.items() if place})
        for name in registry.builtin:
            assert callable(registry.find(name))


def test_scans_are_what_readers_read():
    assert {f".{ending.rpartition('.')[2]}" for ending in READERS} == {*SCANS}


@pytest.mark.parametrize("name", ["notes.txt", "other.json", "none", "poses", "absent", "rum"])
def test_an_unknown_path_is_refused_in_one_line(here, name):
    assert type_of(here / name) is None
    with pytest.raises(DatasetError) as error:
        what_is(here / name)
    line = str(error.value)
    assert name in line
    assert "\n" not in line
    assert ("did you mean" in line) == (name == "rum")
    assert all(other in line for other in TYPES) == (here / name).exists()


def test_another_type_than_expected_is_named(here, capsys):
    check_type(here / "a", "dataset")
    check_type(here / "poses", "dataset")
    assert "known are " in refused(capsys, f"inspect {here}/notes.txt")
    for words in ("verify", "bench", "convert --to ply", "train"):
        line = refused(capsys, f"{words} {here}/run")
        assert "is of type run" in line
        assert "expected dataset" in line
    for words in ("inspect", "render", "view -o x.html"):
        assert "is of type weights" in refused(capsys, f"{words} {here}/net.safetensors")


def test_a_path_is_opened_by_its_type(here):
    for name in ("a", "flights.json", "x.mcap", "scan.pcd", "rooms.toml", "forest.xml"):
        with pytest.raises(Exception, match=name):
            open_path(here / name)
    assert open_path(here / "clouds") == [here / "clouds/deep/1.ply"]
    assert json.loads((here / "other.json").read_text()) == {}
