"""Files that mean harm end in a clear line, soon, in little memory, and write nothing."""

import os
import resource
import struct
import time

import pytest

from scenegen.base.limits import MAX_DOCUMENT_BYTES
from tests.scenegen import cases
from tests.scenegen.verification import forge
from tests.scenegen.verification.conftest import failed

SHARD, WORLDS = "train-00000.h5", "train-00000.worlds.zip"
SECONDS = 20.0
"""Far more than any of these take, on the slowest machine; a hang or a bomb takes more."""


def resident_kb(*processes):
    return max(resource.getrusage(process).ru_maxrss for process in processes)


@pytest.fixture(autouse=True)
def soon_and_small(tmp_path, elsewhere):
    begin = time.monotonic()
    # forked children begin with what this process has, and the figure is the largest of all that
    # ever were
    before = resident_kb(resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    yield
    assert time.monotonic() - begin < SECONDS
    assert resident_kb(resource.RUSAGE_CHILDREN) < before + (1 << 20)
    assert not (tmp_path / "evil").exists()


def test_bytes_that_belong_to_no_sample_are_not_even_hashed(folder):
    os.truncate(folder / SHARD, 1 << 40)  # a hole: a terabyte that takes no space
    assert "samples take" in failed(folder, quick=True)["layout"]
    os.truncate(folder / SHARD, 1_500_000)
    assert "belong to no sample" in failed(folder, quick=True)["layout"]


def test_a_pipe_is_not_waited_for(folder):
    (folder / SHARD).unlink()
    os.mkfifo(folder / SHARD)
    assert f"{SHARD}: is missing, or no file" in failed(folder, quick=True)["layout"]


def world(document):
    return {"000000.xml": document}


def geoms(count, inner=""):
    body = b'<geom size="1"/>' * count
    return b"<mujoco>%s<worldbody>%s</worldbody></mujoco>" % (inner.encode(), body)


MANY = " ".join(f"a{n}='1'" for n in range(101))
DEEP = b"<mujoco><worldbody>" + b"<body>" * 300 + b"</body>" * 300 + b"</worldbody></mujoco>"
SITES = f"<worldbody>{'<site/>' * 5001}</worldbody>"
IMAGE = b"\x89PNG\r\n\x1a\n" + bytes(8) + struct.pack(">II", 10**5, 10**5)
LAUGHS = (
    b'<!DOCTYPE m [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]><mujoco model="&b;"/>'
)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"../evil.xml": b""}, "'../evil.xml': expected a plain file name"),
        ({"world.xml": b""}, "member 'world.xml': expected a world's number"),
        ({"payload.bin": b"unasked"}, "no world in it refers to payload.bin"),
        ({"000009.xml": geoms(1)}, "holds worlds 0 to 9 (3), its samples"),
        (world(b" " * (MAX_DOCUMENT_BYTES + 1)), f"expected {MAX_DOCUMENT_BYTES} at most"),
        (world(b"<mujoco>"), "000000.xml: is not plain XML"),
        (world(LAUGHS), "declares a document type or entities"),
        *((world(geoms(1, inner)), fault) for inner, fault in cases("verification/hostile")),
        (world(DEEP), "200 levels"),
        (world(geoms(50_001)), "more than 50000 geoms"),
        (world(geoms(1, SITES)), "more than 5000 elements besides geom"),
        (world(geoms(1, f"<size {MANY}/>")), "100 attributes of one"),
        ({f"{n:06d}.xml": geoms(1) for n in range(7)}, "7 worlds, expected one a sample"),
        ({"a.png": IMAGE}, "an image of"),
    ],
)
def test_an_archive_that_means_harm_is_named(folder, change, fault):
    forge.rezip(folder / WORLDS, lambda members: members.update(change))
    forge.sign(folder)
    line = failed(folder, quick=True)["archives"]
    assert line.startswith(WORLDS)
    assert fault in line


def test_what_passes_the_screen_but_is_no_world_is_named(folder):
    pyramid = world(b'<mujoco><worldbody><geom type="pyramid"/></worldbody></mujoco>')
    forge.rezip(folder / WORLDS, lambda members: members.update(pyramid))
    forge.sign(folder)
    assert f"{WORLDS}: 000000.xml: not valid MJCF" in failed(folder)["splits"]


def test_a_recipe_without_end_is_given_up(folder, monkeypatch):
    monkeypatch.setattr("scenegen.verification.folder.SECONDS", 1.0)
    monkeypatch.setattr("scenegen.verification.folder.SECONDS_A_SAMPLE", 0.0)
    recipe = forge.read(folder)["recipe"]
    many = recipe["flight"] | {"iterations": 20_000, "flights_per_world": 1000}
    nothing_will_do = recipe["accept"] | {"min_returned_share": 1.0}
    forge.sign(folder, recipe=recipe | {"flight": many, "accept": nothing_will_do})
    fault = f"{SHARD} or {WORLDS}: examining it took too long"
    assert fault in failed(folder, workers=3)["examined"]
