"""What is written in another format, an independent reader finds again."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from scenegen.dataset.read import Dataset
from scenegen.errors import DatasetError
from scenegen.view.exchange import FORMATS
from scenegen.view.exchange.choices import Choices
from scenegen.view.exchange.convert import STATE, convert
from tests.command_line import run


def converted(made: Path, out: Path, to: str, **choices: Any) -> Path:
    made_of = FORMATS.find(to)(Choices(**choices))
    convert(Dataset(made), out, to=to, form=made_of, choices=Choices(**choices), splits=("val",))
    return out


def bits(path: Path, count: int) -> np.ndarray:
    """As SemanticKITTI's development kit unpacks them: the first voxel is the highest bit."""
    return np.array([byte >> (7 - n) & 1 for byte in path.read_bytes() for n in range(8)], bool)[:count]


@pytest.mark.parametrize("unseen", [False, True])
def test_semantickitti(made: Path, tmp_path: Path, unseen: bool) -> None:
    out = converted(made, tmp_path / "out", "semantickitti", unseen_invalid=unseen)
    for number, sample in enumerate(Dataset(made).split("val")):
        stem = out / "sequences" / "08" / "voxels" / f"{number:06d}"
        nx, ny, nz = sample.observed.shape
        observed = bits(stem.with_suffix(".bin"), nx * ny * nz)
        labels = np.fromfile(stem.with_suffix(".label"), np.uint16)
        invalid = bits(stem.with_suffix(".invalid"), nx * ny * nz)
        rng = np.random.default_rng(number)
        for x, y, z in [*np.argwhere(sample.occupancy)[:50], *rng.integers(0, (nx, ny, nz), (200, 3))]:
            at = (x * ny + y) * nz + z
            assert observed[at] == sample.observed[x, y, z]
            assert labels[at] == (50 if sample.occupancy[x, y, z] else 0)
            assert invalid[at] == (unseen and not (sample.observed[x, y, z] or sample.free[x, y, z]))
        assert (labels > 0).sum() == sample.occupancy.sum() > 0
        assert invalid.any() == unseen


@pytest.mark.parametrize("frame", ["body", "world"])
def test_clouds(made: Path, tmp_path: Path, frame: str) -> None:
    for to in ("ply", "pcd", "npz"):
        converted(made, tmp_path / to, to, frame=frame)
    for number, sample in enumerate(Dataset(made).split("val")):
        expected = sample.points(frame=frame)
        assert len(expected)
        ply = trimesh.load(tmp_path / "ply" / "val" / f"{number:06d}.ply")
        np.testing.assert_array_equal(ply.vertices, expected.astype(np.float32))
        np.testing.assert_array_equal(
            read_pcd(tmp_path / "pcd" / "val" / f"{number:06d}.pcd"), expected.astype(np.float32)
        )
        with np.load(tmp_path / "npz" / "val" / f"{number:06d}.npz", allow_pickle=False) as found:
            np.testing.assert_array_equal(found["points"], expected)
            for name in (
                "observed",
                "free",
                "occupancy",
                "tudf",
                "ranges",
                "position",
                "quaternion",
                "origin",
                "world",
            ):
                np.testing.assert_array_equal(found[name], getattr(sample, name))


def read_pcd(path: Path) -> np.ndarray:
    """Points of a binary PCD, by its own header."""
    head, _, body = path.read_bytes().partition(b"DATA binary\n")
    said = {words[0]: words[1:] for words in (line.split() for line in head.decode().splitlines())}
    assert said["VERSION"] == ["0.7"]
    sizes = [f"{kind.lower()}{size}" for kind, size in zip(said["TYPE"], said["SIZE"], strict=True)]
    row = np.dtype(list(zip(said["FIELDS"], sizes, strict=True)))
    assert len(body) == int(said["POINTS"][0]) * row.itemsize == int(said["WIDTH"][0]) * row.itemsize
    table = np.frombuffer(body, row)
    return np.stack([table[name] for name in "xyz"], axis=1)


def test_both_frames_hold_the_same_points(made: Path) -> None:
    sample = Dataset(made).split("val")[0]
    w, x, y, z = sample.quaternion
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    np.testing.assert_allclose(sample.points(frame="body") @ turn.T + sample.position, sample.points(), atol=1e-9)


def test_octomap(made: Path, tmp_path: Path) -> None:
    out = converted(made, tmp_path / "out", "octomap")
    dataset = Dataset(made)
    voxel = dataset.grid.voxel_m
    for number, sample in enumerate(dataset.split("val")):
        resolution, size, leaves, nodes = read_octomap(out / "val" / f"{number:06d}.bt")
        assert resolution == voxel
        assert size == nodes
        known = sample.observed | sample.free
        assert len(leaves) == known.sum() > 0
        for centre, occupied in leaves.items():
            place = (np.array(centre) - sample.origin) / voxel - 0.5
            index = tuple(np.rint(place).astype(int))
            assert np.abs(place - index).max() <= 0.5 + 1e-6
            assert known[index]
            assert sample.observed[index] == occupied


def read_octomap(path: Path) -> tuple[float, int, dict[tuple[float, ...], bool], int]:
    """Resolution, stated size, leaves by their centres, and counted nodes, read recursively."""
    head, _, body = path.read_bytes().partition(b"\ndata\n")
    said = dict(line.split(" ", 1) for line in head.decode().splitlines()[1:])
    assert head.startswith(b"# Octomap OcTree binary file\n")
    assert said["id"] == "OcTree"
    resolution, at, nodes = float(said["res"]), 0, 1
    leaves: dict[tuple[float, ...], bool] = {}

    def read(centre: tuple[float, ...], width: float) -> None:
        nonlocal at, nodes
        (word,) = struct.unpack_from("<H", body, at)
        at += 2
        inner = []
        for child in range(8):
            state = word >> 2 * child & 3
            middle = tuple(c + (width / 4 if child >> axis & 1 else -width / 4) for axis, c in enumerate(centre))
            nodes += state != 0
            if state == 3:
                inner.append(middle)
            elif state:
                assert width / 2 == pytest.approx(resolution)
                leaves[middle] = state == 2
        for middle in inner:
            read(middle, width / 2)

    read((0.0, 0.0, 0.0), resolution * 2**16)
    assert at == len(body)
    return resolution, int(said["size"]), leaves, nodes


def test_a_stopped_conversion_goes_on(made: Path, tmp_path: Path) -> None:
    whole, out, choices = converted(made, tmp_path / "whole", "semantickitti"), tmp_path / "out", Choices()
    form, seen = FORMATS.find("semantickitti")(choices), 0

    def stop() -> None:
        nonlocal seen
        seen += 1
        if seen == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        convert(Dataset(made), out, to="semantickitti", form=form, choices=choices, splits=("val",), on_sample=stop)
    next(out.rglob("*.invalid")).unlink()  # as if stopped within the first sample
    done = convert(Dataset(made), out, to="semantickitti", form=form, choices=choices, splits=("val",))
    assert (done.written, done.there) == (2, 0)
    done = convert(Dataset(made), out, to="semantickitti", form=form, choices=choices, splits=("val",))
    assert (done.written, done.there) == (0, 2)
    files = sorted(path.relative_to(whole) for path in whole.rglob("*") if path.is_file())
    assert files == sorted(path.relative_to(out) for path in out.rglob("*") if path.is_file())
    assert all((whole / path).read_bytes() == (out / path).read_bytes() for path in files)
    with pytest.raises(DatasetError, match="another conversion"):
        converted(made, out, "semantickitti", label=70)
    with pytest.raises(DatasetError, match="another conversion"):
        converted(made, out, "ply")


def test_a_folder_of_others_is_let_be(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("mine")
    code, _, said = run(capsys, "convert", made, "--to", "ply", "-o", tmp_path / "mine")
    assert (code, said.count("\n")) == (1, 1)
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.txt"]


def test_what_cannot_be_read_is_named_and_the_rest_is_written(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (dataset / "train-00001.h5").unlink()
    out = tmp_path / "out"
    code, _, said = run(capsys, "convert", dataset, "--to", "pcd", "-o", out, "--split", "train", "--quiet")
    assert code == 1
    assert [f"train {number} is left out" in said for number in range(2, 7)] == [False, True, True, True, False]
    assert said.splitlines()[-1] == f"scenegen: {dataset}: 3 samples could not be read; the others are in {out}"
    assert len(list(out.rglob("*.pcd"))) == 8
    assert json.loads((out / STATE).read_text())["format"] == "pcd"


def test_a_format_of_ones_own(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    (tmp_path / "my_format_of_tests.py").write_text(
        "class Counts:\n"
        "    def __init__(self, choices): pass\n"
        "    def names(self, split, number): return (f'{split}-{number}.txt',)\n"
        "    def encode(self, sample, grid, lidar): return (str(sample.occupancy.sum()).encode(),)\n"
    )
    monkeypatch.chdir(tmp_path)
    code, _, said = run(capsys, "convert", made, "--to", "my_format_of_tests:Counts", "-o", "out", "--quiet")
    assert code == 0, said
    for number, sample in enumerate(Dataset(made).split("test")):
        assert int((tmp_path / "out" / f"test-{number}.txt").read_text()) == sample.occupancy.sum()
