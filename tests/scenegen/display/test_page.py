"""A page holds what its samples hold, asks no network, and takes nothing of a stranger's for a
script."""

import base64
import gzip
import hashlib
import json
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from lidarsim import GridSpec
from scenegen.dataset.read import Dataset
from scenegen.display.look import look_at, looks, spread
from scenegen.display.page import HERE, MOST_VOXELS, page
from scenegen.errors import DatasetError
from tests.command_line import run

HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>--><b>%%DATA%%&amp;\u2028"


class Seen(HTMLParser):
    """Elements of a page: tag, attributes and text."""

    def __init__(self, text: str):
        super().__init__()
        self.found: list[list[Any]] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append([tag, dict(attrs), ""])

    def handle_data(self, data: str) -> None:
        if self.found:
            self.found[-1][2] += data

    def data(self) -> Any:
        (text,) = [text for tag, attributes, text in self.found if attributes.get("id") == "data"]
        return json.loads(text)


def unpacked(text: str) -> bytes:
    return gzip.decompress(base64.b64decode(text))


def test_a_page_holds_what_its_samples_hold(made: Path) -> None:
    dataset = Dataset(made)
    shown, notes = looks(dataset, "train", [0, 7])
    data = Seen(page(shown, title="small")).data()
    assert notes == []
    assert [sample["name"] for sample in data["samples"]] == ["train 0", "train 7"]
    for packed, index in zip(data["samples"], (0, 7), strict=True):
        sample = dataset.split("train")[index]
        for name in ("observed", "free", "occupancy"):
            bits = np.unpackbits(np.frombuffer(unpacked(packed["masks"][name]), np.uint8))
            np.testing.assert_array_equal(
                bits[: sample.observed.size].reshape(sample.observed.shape), getattr(sample, name)
            )
        distances = (
            np.frombuffer(unpacked(packed["tudf"]), np.uint8).reshape(sample.tudf.shape) / 255
        )
        np.testing.assert_allclose(
            distances * packed["truncation"], sample.tudf, atol=packed["truncation"] / 510 + 1e-6
        )
        points = (
            np.frombuffer(unpacked(packed["points"]), "<i2").reshape(-1, 3)
            / 32767
            * packed["reach"]
        )
        np.testing.assert_allclose(
            points + sample.position, sample.points(), atol=packed["reach"] / 65534 + 1e-9
        )
        assert packed["figures"]["returns"] == f"{len(points)} of {sample.ranges.size} rays"


def test_a_hostile_dataset_runs_no_script(made: Path) -> None:
    (look,), _ = looks(Dataset(made), "train", [0])
    good = Seen(page([look], title="good"))
    text = page(
        [replace(look, name=HOSTILE, masks={HOSTILE: look.masks["free"]})],
        title=HOSTILE,
        notes=[HOSTILE],
    )
    bad = Seen(text)
    assert [(tag, sorted(names)) for tag, names, _ in bad.found] == [
        (tag, sorted(names)) for tag, names, _ in good.found
    ]
    data = bad.data()
    assert data["title"] == data["notes"][0] == data["samples"][0]["name"] == HOSTILE
    scripts = [(names, text) for tag, names, text in bad.found if tag == "script"]
    running = [
        names for names, _ in scripts if not names.get("type", "").startswith("application/")
    ]
    (policy,) = [
        names["content"] for tag, names, _ in bad.found if tag == "meta" and "http-equiv" in names
    ]
    assert len(running) == 1
    assert f"script-src 'nonce-{running[0]['nonce']}' blob:;" in policy
    assert "default-src 'none'" in policy  # so nothing is loaded, whatever else stands in the page
    assert not any(
        name.startswith("on") or name in ("src", "href")
        for _, names, _ in bad.found
        for name in names
    )
    script = HERE.joinpath("page.js").read_text(encoding="utf-8")
    assert not [
        word
        for word in ("innerHTML", "outerHTML", "insertAdjacentHTML", "document.write", "eval(")
        if word in script
    ]


def test_the_renderer_is_unmodified_and_its_licence_is_in_the_page(made: Path) -> None:
    listed = HERE.joinpath("three", "README.md").read_text(encoding="utf-8")
    for name in ("three.module.min.js", "OrbitControls.js", "LICENSE"):
        digest = hashlib.sha256(HERE.joinpath("three", name).read_bytes()).hexdigest()
        assert f"| `{name}` | {digest} |" in listed
    shown, _ = looks(Dataset(made), "train", [0])
    text = page(shown, title="small")
    elements = {names.get("id"): text for _, names, text in Seen(text).found}
    assert hashlib.sha256(unpacked(elements["three"])).hexdigest() in listed
    assert hashlib.sha256(unpacked(elements["orbit"])).hexdigest() in listed
    assert "The MIT License" in text
    assert "three.js authors" in text


def test_a_damaged_dataset_is_shown_as_far_as_it_is_sound(
    dataset: Path, tmp_path: Path, capsys: Any
) -> None:
    (dataset / "train-00001.h5").unlink()  # samples 3 to 5
    with h5py.File(dataset / "train-00000.h5", "r") as file:
        place = file["tudf"].id.get_chunk_info(1)
    with open(dataset / "train-00000.h5", "r+b") as raw:
        raw.seek(place.byte_offset)
        raw.write(bytes(place.size))
    shown, notes = looks(Dataset(dataset), "train", [0, 1, 4, 6])
    assert [look.name for look in shown] == ["train 0", "train 1", "train 6"]
    assert shown[0].tudf is not None
    assert shown[1].tudf is None
    assert "occupancy" in shown[1].masks
    assert len(notes) == 2
    assert any("train 4 is not shown" in line and "train-00001.h5" in line for line in notes)
    assert any("train 1: tudf is not shown" in line for line in notes)
    assert Seen(page(shown, title="", notes=notes)).data()["notes"] == notes
    code, _, said = run(capsys, "view", dataset, "--index", 4, "-o", tmp_path / "none.html")
    assert code == 1
    assert said.count("\n") == 1
    assert not (tmp_path / "none.html").exists()
    code, _, said = run(capsys, "view", dataset, "--index", 11, "-o", tmp_path / "none.html")
    assert (code, said.count("\n")) == (1, 1)
    assert "--index below 11" in said


def test_an_incomplete_dataset_is_shown_with_a_line(
    dataset: Path, tmp_path: Path, capsys: Any
) -> None:
    manifest = json.loads((dataset / "dataset.json").read_text())
    last = manifest["shards"].pop()
    manifest |= {"complete": False, "digest": None}
    (dataset / "dataset.json").write_text(json.dumps(manifest))
    (dataset / last["file"]).unlink()
    code, _, noted = run(capsys, "view", dataset, "--n", 3, "--html", tmp_path / "page.html")
    assert code == 0, noted
    assert "incomplete" in noted
    data = Seen((tmp_path / "page.html").read_text(encoding="utf-8")).data()
    assert "incomplete" in data["notes"][0]
    assert [sample["name"] for sample in data["samples"]] == ["train 0", "train 5", "train 10"]


def test_numbers_are_spread_over_the_split(made: Path) -> None:
    dataset = Dataset(made)
    assert spread(dataset, "train", 100) == list(range(11))
    assert spread(dataset, "train", 3) == [0, 5, 10]
    assert spread(dataset, "train", 1) == [0]


def test_a_grid_that_no_browser_takes_is_refused(made: Path) -> None:
    (look,), _ = looks(Dataset(made), "train", [0])
    with pytest.raises(DatasetError, match=f"{MOST_VOXELS} at most"):
        page([replace(look, grid=GridSpec(shape=(256, 256, 128)))], title="")


def test_a_pose_that_is_none_is_an_error(made: Path) -> None:
    dataset = Dataset(made)
    sample = dataset.split("train")[0]
    sample.__dict__["position"] = np.array([np.nan, 0, 0])
    with pytest.raises(DatasetError, match="pose"):
        look_at(sample, dataset.grid, dataset.lidar, "train 0")


def test_a_page_too_large_to_mail_holds_fewer_samples_and_says_so(
    made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown, _ = looks(Dataset(made), "train", [0, 1, 2])
    whole = Seen(page(shown, title="")).data()["samples"]
    monkeypatch.setattr(
        "scenegen.display.page.MOST_BYTES", sum(len(json.dumps(one)) for one in whole[:2]) + 10
    )
    data = Seen(page(shown, title="")).data()
    assert data["samples"] == whole[:2]
    assert data["notes"] == ["1 samples are left out: the page would be too large"]
