"""A page holds what its samples hold, asks no network, and takes nothing of a stranger's for a
script."""

import base64
import gzip
import hashlib
import json
from dataclasses import replace
from html.parser import HTMLParser

import h5py
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from lidarsim import GridSpec, Lidar
from scenegen.base.errors import ScenegenError
from scenegen.dataset.read import Dataset
from scenegen.view.look import Guess, field_of_view, look_at, looks
from scenegen.view.page import HERE, page
from scenegen.worlds.movers import encoded
from tests.refusals import refuses, refuses_command
from tests.scenegen.test_moving_samples import moving as moving  # a fixture
from tests.scenegen.verification.forge import edit_manifest

HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>--><b>%%DATA%%&amp;\u2028"


class Seen(HTMLParser):
    """Elements of a page: tag, attributes and text."""

    def __init__(self, text):
        super().__init__()
        self.found = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.found.append([tag, dict(attrs), ""])

    def handle_data(self, data):
        if self.found:
            self.found[-1][2] += data

    def data(self):
        (text,) = [text for _, attributes, text in self.found if attributes.get("id") == "data"]
        return json.loads(text)

    def policy(self):
        (found,) = [names["content"] for _, names, _ in self.found if "http-equiv" in names]
        return found


def unpacked(text):
    return gzip.decompress(base64.b64decode(text))


def array(text, kind="u1"):
    """An array of a page."""
    return np.frombuffer(unpacked(text), kind)


def test_a_page_holds_what_its_samples_hold(made):
    dataset = Dataset(made)
    shown, notes = looks(dataset, "train", [0, 7])
    data = Seen(page(shown, title="small")).data()
    assert notes == []
    assert [sample["name"] for sample in data["samples"]] == ["train 0", "train 7"]
    for packed, index in zip(data["samples"], (0, 7), strict=True):
        sample = dataset.split("train")[index]
        shape, far, reach = sample.observed.shape, packed["truncation"], packed["reach"]
        for name in ("observed", "free", "occupancy"):
            bits = np.unpackbits(array(packed["masks"][name]), count=sample.observed.size)
            assert_array_equal(bits.reshape(shape), getattr(sample, name))
        distances = array(packed["tudf"]).reshape(shape) / 255 * far
        assert_allclose(distances, sample.tudf, atol=far / 510 + 1e-6)
        points = array(packed["points"], "<i2").reshape(-1, 3) / 32767 * reach
        assert_allclose(points + sample.position, sample.points(), atol=reach / 65534 + 1e-9)
        assert packed["figures"]["returns"] == f"{len(points)} of {sample.ranges.size} rays"


def test_classes_and_doubt_are_in_the_page(look, rng):
    numbers = rng.integers(0, 3, look.grid.shape).astype(np.uint16)
    chance = rng.random(look.grid.shape)
    guess = Guess(name="mine", occupied=chance > 0.5, tudf=None, chance=chance)
    names = ("nothing", "tree", "wall")
    shown = replace(look, classes=(numbers, names), guesses=(guess,))
    (packed,) = Seen(page([shown], title="")).data()["samples"]
    assert_array_equal(array(packed["classes"]["voxels"], "<u2"), numbers.ravel())
    assert packed["classes"]["names"] == [*names]
    assert_allclose(array(packed["guesses"][0]["chance"]) / 255, chance.ravel(), atol=1 / 509)


def test_movers_are_a_small_part_of_a_page(moving):
    """test_browser.py has where the script draws them."""
    split = Dataset(moving).split("train")
    shown, _ = looks(split.dataset, "train", range(len(split)))
    samples = Seen(page(shown, title="")).data()["samples"]
    for packed, sample in zip((one["movers"] for one in samples), split, strict=True):
        bits = np.unpackbits(array(packed["standing"]))
        assert_array_equal(bits, sample.static_occupancy.ravel())
        assert unpacked(packed["table"]).decode() == encoded(sample.motion.movers)
        times = packed["now"] + np.array([*packed["scans"], packed["end"]])
        assert_allclose(times, [*sample.scan_times, sample.course_end])
        assert packed["now"] == sample.scan_times[0]
        assert len(json.dumps(packed)) < 20_000


def test_what_moves_in_damage_is_left_out(moving):
    sample = Dataset(moving).split("train")[0]
    sample.__dict__["scan_times"] = np.full(3, np.nan)
    shown = look_at(sample, sample.grid, sample.lidar, "train 0")
    assert shown.timeline is None
    assert "what moves is not shown" in shown.missing[0]


def test_the_field_of_view_is_that_of_the_rays():
    around = Lidar(vertical_fov_deg=30, pitch_deg=10, mount="band")
    assert_allclose(field_of_view(around), (-180, 177, -25, 5), atol=0.01)
    ahead = Lidar(vertical_fov_deg=30, pitch_deg=0, horizontal_fov_deg=90)
    assert_allclose(field_of_view(ahead)[:2], (-45, 45), atol=0.01)


def test_a_hostile_dataset_runs_no_script(look):
    hostile = replace(look, name=HOSTILE, masks={HOSTILE: look.masks["free"]})
    good = Seen(page([look], title="good"))
    bad = Seen(page([hostile], title=HOSTILE, notes=[HOSTILE]))
    tags, expected = (
        [(tag, sorted(names)) for tag, names, _ in seen.found] for seen in (bad, good)
    )
    assert tags == expected
    data = bad.data()
    assert data["title"] == data["notes"][0] == data["samples"][0]["name"] == HOSTILE
    (nonce,) = {names["nonce"] for tag, names, _ in bad.found if "nonce" in names}
    assert f"script-src 'nonce-{nonce}';" in bad.policy()
    assert "default-src 'none'" in bad.policy()  # so nothing is loaded, whatever else stands there
    attributes = {name for _, names, _ in bad.found for name in names}
    assert not [name for name in attributes if name.startswith("on") or name in ("src", "href")]
    script = HERE.joinpath("page.js").read_text(encoding="utf-8")
    words = "innerHTML", "outerHTML", "insertAdjacentHTML", "document.write", "eval("
    assert [word for word in words if word in script] == []


def test_the_renderer_is_unmodified_and_its_licence_is_in_the_page(look):
    listed = HERE.joinpath("three", "README.md").read_text(encoding="utf-8")
    for name in ("three.module.min.js", "OrbitControls.js", "LICENSE"):
        digest = hashlib.sha256(HERE.joinpath("three", name).read_bytes()).hexdigest()
        assert f"| `{name}` | {digest} |" in listed
    text = page([look], title="small")
    elements = {names.get("id"): text for _, names, text in Seen(text).found}
    for part in ("three", "orbit"):
        assert hashlib.sha256(unpacked(elements[part])).hexdigest() in listed
    assert "three.js authors" in text


def test_a_damaged_dataset_is_shown_as_far_as_it_is_sound(dataset, standing, capsys):
    (dataset / "train-00001.h5").unlink()  # samples 3 to 5
    with h5py.File(dataset / "train-00000.h5", "r") as file:
        place = file["tudf"].id.get_chunk_info(1)
    with open(dataset / "train-00000.h5", "r+b") as raw:
        raw.seek(place.byte_offset)
        raw.write(bytes(place.size))
    shown, notes = looks(Dataset(dataset), "train", [0, 1, 4, 6])
    distances = {look.name: look.tudf is not None for look in shown}
    assert distances == {"train 0": True, "train 1": False, "train 6": True}
    assert "occupancy" in shown[1].masks
    unread, gone = sorted(notes)
    assert unread.startswith("train 1: tudf is not shown")
    assert "train-00001.h5" in gone.partition("train 4 is not shown")[2]
    assert Seen(page(shown, title="", notes=notes)).data()["notes"] == notes
    for index in (4, 11):
        refuses_command(capsys, f"view data/pillar --index {index} -o no.html")
    edit_manifest(dataset, shards=[], complete=False)
    for words in ("view data/pillar -o no.html", "render data/pillar -o no.png"):
        refuses_command(capsys, words)
    assert not list(standing.glob("no.*"))


def test_what_cannot_be_shown_is_an_error(made, look):
    """A grid that no browser takes, and a pose that is none."""
    large = replace(look, grid=GridSpec(shape=(256, 256, 128)))
    refuses("grid", page, [large], title="", error=ScenegenError)
    dataset = Dataset(made)
    sample = dataset.split("train")[0]
    sample.__dict__["position"] = np.array([np.nan, 0, 0])
    sensor = dataset.grid, dataset.lidar
    refuses("pose", look_at, sample, *sensor, "train 0", error=ScenegenError)


def test_a_page_too_large_to_mail_holds_fewer_samples_and_says_so(made, monkeypatch):
    shown, _ = looks(Dataset(made), "train", [0, 1, 2])
    whole = Seen(page(shown, title="")).data()["samples"]
    size = sum(len(json.dumps(sample)) for sample in whole[:2])
    monkeypatch.setattr("scenegen.view.page.MAX_BYTES", size + 10)
    data = Seen(page(shown, title="")).data()
    assert data["samples"] == whole[:2]
    assert "1 samples are left out" in data["notes"][0]
