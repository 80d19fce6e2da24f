"""A path is recognised by its name, its files and its first bytes; what is unknown is refused."""

import zipfile

import pytest

from lidarsim.registry import Registry
from scenegen.base.paths import SCANS, TYPES, check_type, open_path, type_of, what_is
from scenegen.worlds.clouds import READERS
from tests.refusals import refuses, refuses_command
from tests.scenegen import cases

EXPECTED = dict(cases("types"))
"""Types of paths, some of which are there."""


@pytest.fixture
def here(tmp_path):
    for name, text in cases("files"):
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
    refuses(name, what_is, here / name)


def test_another_type_than_expected_is_named(here, capsys):
    check_type(here / "a", "dataset")
    check_type(here / "poses", "dataset")
    for words in ("verify", "bench", "convert --to ply", "train"):
        refuses_command(capsys, f"{words} {here}/run")
    for words in ("inspect", "render", "view -o x.html"):
        refuses_command(capsys, f"{words} {here}/net.safetensors")


def test_a_path_is_opened_by_its_type(here):
    for name in ("a", "flights.json", "x.mcap", "scan.pcd", "rooms.toml", "forest.xml"):
        with pytest.raises(Exception, match=name):
            open_path(here / name)
    assert open_path(here / "clouds") == [here / "clouds/deep/1.ply"]
