"""Files that mean harm end in a clear line, soon, in little memory, and write nothing."""

import os
import resource
import struct
import time

import pytest

from scenegen.base.limits import MAX_DOCUMENT_BYTES
from tests.scenegen import cases
from tests.scenegen.verification import forge
from tests.scenegen.verification.conftest import finds

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
    finds("terabyte", folder, "layout", quick=True)
    os.truncate(folder / SHARD, 1_500_000)
    finds("megabyte", folder, "layout", quick=True)


def test_a_pipe_is_not_waited_for(folder):
    (folder / SHARD).unlink()
    os.mkfifo(folder / SHARD)
    finds("pipe", folder, "layout", quick=True)


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


HARM = {
    "outside": {"../evil.xml": b""},
    "no number": {"world.xml": b""},
    "unasked": {"payload.bin": b"unasked"},
    "no sample": {"000009.xml": geoms(1)},
    "large": world(b" " * (MAX_DOCUMENT_BYTES + 1)),
    "no XML": world(b"<mujoco>"),
    "laughs": world(LAUGHS),
    **{inner: world(geoms(1, inner)) for (inner,) in cases("verification/hostile")},
    "deep": world(DEEP),
    "geoms": world(geoms(50_001)),
    "sites": world(geoms(1, SITES)),
    "attributes": world(geoms(1, f"<size {MANY}/>")),
    "worlds": {f"{n:06d}.xml": geoms(1) for n in range(7)},
    "image": {"a.png": IMAGE},
}


@pytest.mark.parametrize("case", HARM)
def test_an_archive_that_means_harm_is_named(folder, case):
    forge.rezip(folder / WORLDS, lambda members: members.update(HARM[case]))
    forge.sign(folder)
    finds(case, folder, "archives", quick=True)


def test_what_passes_the_screen_but_is_no_world_is_named(folder):
    pyramid = world(b'<mujoco><worldbody><geom type="pyramid"/></worldbody></mujoco>')
    forge.rezip(folder / WORLDS, lambda members: members.update(pyramid))
    forge.sign(folder)
    finds("pyramid", folder, "splits")


def test_a_recipe_without_end_is_given_up(folder, monkeypatch):
    monkeypatch.setattr("scenegen.verification.folder.SECONDS", 0.2)
    monkeypatch.setattr("scenegen.verification.folder.SECONDS_A_SAMPLE", 0.0)
    recipe = forge.read(folder)["recipe"]
    many = recipe["flight"] | {"iterations": 20_000, "flights_per_world": 1000}
    nothing_will_do = recipe["accept"] | {"min_returned_share": 1.0}
    forge.sign(folder, recipe=recipe | {"flight": many, "accept": nothing_will_do})
    finds("endless", folder, "examined", workers=3)
