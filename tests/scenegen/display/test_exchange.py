"""What is written in another format, an independent reader finds again."""

import json
import multiprocessing
import os
import signal
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import trimesh

from lidarsim import GridSpec
from lidarsim.solids.shapes import BOX, CAPSULE, CYLINDER, ELLIPSOID, SPHERE
from scenegen.dataset.read import Dataset
from scenegen.display.exchange import Choices
from scenegen.display.exchange.convert import STATE, convert
from scenegen.display.exchange.recordings import rerun as import_rerun
from scenegen.errors import DatasetError
from scenegen.sample import Sample
from scenegen.source import read_world
from tests.command_line import run
from tests.test_silence import environment, noted, shim  # noqa: F401 (shim is a fixture)


def converted(made: Path, out: Path, to: str, **choices: Any) -> Path:
    convert(Dataset(made), out, to=to, choices=Choices(**choices), splits=("val",))
    return out


def bits(path: Path, count: int) -> np.ndarray:
    """As SemanticKITTI's development kit unpacks them: the first voxel is the highest bit."""
    return np.array([byte >> (7 - n) & 1 for byte in path.read_bytes() for n in range(8)], bool)[
        :count
    ]


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
        for x, y, z in [
            *np.argwhere(sample.occupancy)[:50],
            *rng.integers(0, (nx, ny, nz), (200, 3)),
        ]:
            at = (x * ny + y) * nz + z
            assert observed[at] == sample.observed[x, y, z]
            assert labels[at] == (50 if sample.occupancy[x, y, z] else 0)
            assert invalid[at] == (
                unseen and not (sample.observed[x, y, z] or sample.free[x, y, z])
            )
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
    assert (
        len(body) == int(said["POINTS"][0]) * row.itemsize == int(said["WIDTH"][0]) * row.itemsize
    )
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
    np.testing.assert_allclose(
        sample.points(frame="body") @ turn.T + sample.position, sample.points(), atol=1e-9
    )


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
            middle = tuple(
                c + (width / 4 if child >> axis & 1 else -width / 4)
                for axis, c in enumerate(centre)
            )
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


def test_a_stopped_conversion_goes_on(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("scenegen.display.exchange.convert.CHUNK", 1)
    whole, out, choices = (
        converted(made, tmp_path / "whole", "semantickitti"),
        tmp_path / "out",
        Choices(),
    )
    seen = 0

    def stop(count: int) -> None:
        nonlocal seen
        seen += 1
        if seen == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        convert(
            Dataset(made),
            out,
            to="semantickitti",
            choices=choices,
            splits=("val",),
            on_sample=stop,
        )
    next(out.rglob("*.invalid")).unlink()  # as if stopped within the first sample
    done = convert(Dataset(made), out, to="semantickitti", choices=choices, splits=("val",))
    assert (done.written, done.there) == (2, 0)
    done = convert(Dataset(made), out, to="semantickitti", choices=choices, splits=("val",))
    assert (done.written, done.there) == (0, 2)
    files = sorted(path.relative_to(whole) for path in whole.rglob("*") if path.is_file())
    assert files == sorted(path.relative_to(out) for path in out.rglob("*") if path.is_file())
    assert all((whole / path).read_bytes() == (out / path).read_bytes() for path in files)
    with pytest.raises(DatasetError, match="another conversion"):
        converted(made, out, "semantickitti", label=70)
    with pytest.raises(DatasetError, match="another conversion"):
        converted(made, out, "ply")


@pytest.mark.parametrize("killed_at", [0, 1])
@pytest.mark.parametrize("to", ["npz", "semantickitti"])
def test_what_a_killed_conversion_leaves_is_taken_away(
    to: str, killed_at: int, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At its own description, or at the first sample."""
    plain, put = Path.replace, list[Path]()

    def dies(draft: Path, path: Path) -> None:
        if len(put) == killed_at:
            os.kill(os.getpid(), signal.SIGKILL)
        put.append(path)
        plain(draft, path)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", dies)
        killed = multiprocessing.get_context("fork").Process(
            target=converted, args=(made, tmp_path / "out", to)
        )
        killed.start()
        killed.join()
    assert killed.exitcode == -signal.SIGKILL
    assert list((tmp_path / "out").rglob("*.tmp"))
    converted(made, tmp_path / "out", to)
    assert not list((tmp_path / "out").rglob("*.tmp"))


def test_a_folder_of_others_is_let_be(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("mine")
    code, _, said = run(capsys, "convert", made, "--to", "ply", "-o", tmp_path / "mine")
    assert (code, said.count("\n")) == (1, 1)
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.txt"]


def test_what_cannot_be_read_is_named_and_the_rest_is_written(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (dataset / "train-00001.h5").unlink()
    with h5py.File(dataset / "train-00000.h5", "r+") as shard:
        shard["position"][1] += 0.05
    out = tmp_path / "out"
    code, _, said = run(
        capsys, "convert", dataset, "--to", "pcd", "-o", out, "--split", "train", "--quiet"
    )
    assert code == 1
    assert [f"train {n} is left out" in said for n in range(7)] == [
        False,
        True,
        False,
        True,
        True,
        True,
        False,
    ]
    assert "train-00000.h5: sample 1: its content does not have the digest" in said
    assert (
        said.splitlines()[-1]
        == f"scenegen: {dataset}: 4 samples could not be read; the others are in {out}"
    )
    assert len(list(out.rglob("*.pcd"))) == 7
    assert json.loads((out / STATE).read_text())["format"] == "pcd"


def test_a_format_of_ones_own(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    (tmp_path / "my_format_of_tests.py").write_text(
        "class Counts:\n"
        "    def __init__(self, choices): pass\n"
        "    def names(self, split, number): return (f'{split}-{number}.txt',)\n"
        "    def encode(self, sample, grid, lidar): return "
        "(str(sample.occupancy.sum()).encode(),)\n"
    )
    monkeypatch.chdir(tmp_path)
    code, _, said = run(
        capsys, "convert", made, "--to", "my_format_of_tests:Counts", "-o", "out", "--quiet"
    )
    assert code == 0, said
    for number, sample in enumerate(Dataset(made).split("test")):
        assert int((tmp_path / "out" / f"test-{number}.txt").read_text()) == sample.occupancy.sum()


SENSED = ("observed", "free", "occupancy")


def test_webdataset_s_own_loader_finds_every_sample(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    webdataset = pytest.importorskip("webdataset", reason="webdataset is not installed")
    monkeypatch.setattr("scenegen.display.exchange.files.WebDataset.together", 2)
    out = converted(made, tmp_path / "out", "webdataset")
    samples = list(Dataset(made).split("val"))
    shards = sorted(map(str, out.glob("val-*.tar")))
    assert len(shards) == -(-len(samples) // 2)
    found = list(webdataset.WebDataset(shards, shardshuffle=False).decode())
    assert [one["__key__"] for one in found] == [f"{n:06d}" for n in range(len(samples))]
    for one, sample in zip(found, samples, strict=True):
        assert one["json"]["world"] == sample.world
        for name in (*SENSED, "tudf"):
            np.testing.assert_array_equal(one["npz"][name], getattr(sample, name))
    again = converted(made, tmp_path / "again", "webdataset")
    assert [path.read_bytes() for path in sorted(again.glob("*.tar"))] == [
        Path(path).read_bytes() for path in shards
    ]


def test_mcap_s_own_reader_and_ros_s_decoder_find_every_message(made: Path, tmp_path: Path) -> None:
    reader = pytest.importorskip("mcap.reader", reason="mcap is not installed")
    ros2 = pytest.importorskip("mcap_ros2.decoder", reason="mcap-ros2-support is not installed")
    out = converted(made, tmp_path / "out", "mcap")
    samples, grid = Dataset(made).split("val"), Dataset(made).grid
    seen = set()
    with open(out / "val-000000.mcap", "rb") as file:
        read = reader.make_reader(
            file, decoder_factories=[ros2.DecoderFactory()], validate_crcs=True
        )
        for schema, channel, message, decoded in read.iter_decoded_messages():
            number, topic = message.sequence, channel.topic[1:]
            seen.add((number, topic))
            sample = samples[number]
            if topic == "map":
                assert (decoded.timestamp.sec, decoded.frame_id) == (number, "world")
                assert schema.name == "foxglove_msgs/msg/VoxelGrid"
                shown_as_foxglove_reads_it(decoded, sample, grid)
                continue
            assert (decoded.header.stamp.sec, decoded.header.frame_id) == (number, "world")
            if topic == "pose":
                at, turned = decoded.pose.position, decoded.pose.orientation
                assert (at.x, at.y, at.z) == tuple(sample.position)
                assert (turned.w, turned.x, turned.y, turned.z) == tuple(sample.quaternion)
                continue
            assert schema.name == "sensor_msgs/msg/PointCloud2"
            assert [(one.name, one.offset, one.datatype, one.count) for one in decoded.fields] == [
                ("x", 0, 7, 1),
                ("y", 4, 7, 1),
                ("z", 8, 7, 1),
            ]
            points = np.frombuffer(bytes(decoded.data), "<f4").reshape(decoded.width, 3)
            assert decoded.row_step == decoded.point_step * decoded.width == len(decoded.data)
            expected = (
                sample.points()
                if topic == "scan"
                else grid.centres(sample.origin)[getattr(sample, topic)]
            )
            np.testing.assert_array_equal(points, expected.astype(np.float32))
    assert seen == {
        (n, topic) for n in range(len(samples)) for topic in (*SENSED, "scan", "map", "pose")
    }


def shown_as_foxglove_reads_it(found: Any, sample: Sample, grid: GridSpec) -> None:
    """Where the cell of a byte lies is as https://docs.foxglove.dev/docs/sdk/schemas/voxel-grid
    says."""
    data = np.frombuffer(bytes(found.data), np.uint8)
    assert [(one.name, one.offset, one.type) for one in found.fields] == [
        (name, n, 1) for n, name in enumerate(SENSED)
    ]
    assert (found.column_count, found.row_count) == grid.shape[:2]
    assert len(data) == found.slice_stride * grid.shape[2]
    i = np.arange(0, len(data), found.cell_stride)
    cells = np.stack(
        [
            i % found.row_stride // found.cell_stride * found.cell_size.x,
            i % found.slice_stride // found.row_stride * found.cell_size.y,
            i // found.slice_stride * found.cell_size.z,
        ],
        axis=-1,
    )
    corner = found.pose.position
    assert (corner.x, corner.y, corner.z) == tuple(sample.origin)
    assert found.pose.orientation.w == 1
    for field in found.fields:
        held = sample.origin + cells[data[i + field.offset] == 1] + grid.voxel_m / 2
        expected = grid.centres(sample.origin)[getattr(sample, field.name)]
        np.testing.assert_allclose(
            *(points[np.lexsort(points.round(6).T)] for points in (held, expected)), atol=1e-9
        )


RERUN = """
import os, sys
from pathlib import Path
sys.argv = ["scenegen", "convert", sys.argv[1], "--to", "rerun", "--split", "val", "-o", sys.argv[2], "--quiet"]
os.environ["FORCE_RERUN_ANALYTICS"] = "1"
class Watch:
    def find_spec(self, name, path=None, target=None):
        if name == "rerun":
            found = {key: os.environ.get(key) for key in ("FORCE_RERUN_ANALYTICS", "CI", "TELEMETRY_ENABLED")}
            assert found == {"FORCE_RERUN_ANALYTICS": None, "CI": "true", "TELEMETRY_ENABLED": "false"}, found
            print("watched")
sys.meta_path.insert(0, Watch())
from scenegen.__main__ import main
main()
"""


def test_rerun_s_own_reader_finds_every_sample_and_nothing_is_reported(
    made: Path,
    tmp_path: Path,
    shim: Path,  # noqa: F811
    monkeypatch: Any,
) -> None:
    pytest.importorskip("rerun_bindings", reason="rerun-sdk is not installed")
    given = environment(shim, tmp_path)
    ended = subprocess.run(
        [sys.executable, "-c", RERUN, made, tmp_path / "out"],
        env=given,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    assert "watched" in ended.stdout
    assert noted(tmp_path) == []
    assert list((tmp_path / "home").rglob("*.json")) == []
    for name in ("CI", "TELEMETRY_ENABLED"):
        monkeypatch.setenv(name, "")  # so that it is put back
    import_rerun()
    from rerun.chunk import RrdReader

    dataset = Dataset(made)
    samples, seen = dataset.split("val"), set()
    for chunk in RrdReader(tmp_path / "out" / "val-000000.rrd").stream():
        if (name := chunk.entity_path.strip("/")) not in (*SENSED, "scan"):
            continue
        batch = chunk.to_record_batch()
        for number, points in zip(
            batch["sample"].to_pylist(), batch["Points3D:positions"].to_pylist(), strict=True
        ):
            seen.add((number, name))
            sample = samples[number]
            centres = dataset.grid.centres(sample.origin)
            expected = sample.points() if name == "scan" else centres[getattr(sample, name)]
            np.testing.assert_array_equal(np.array(points, np.float32), expected.astype(np.float32))
    assert seen == {(n, name) for n in range(len(samples)) for name in (*SENSED, "scan")}


def test_a_world_s_surfaces_are_where_its_solids_are(
    made: Path, tmp_path: Path, capsys: Any
) -> None:
    """Of every shape, against another reader of meshes' volumes and bounds; y is up there."""
    (tmp_path / "w.xml").write_text(
        "<mujoco><custom><numeric name='flight_bounds' data='0 0 0 10 8 4'/></custom><worldbody>"
        "<geom type='sphere' size='1' pos='4 4 2' rgba='1 0 0 1'/>"
        "<geom type='box' size='.5 .6 .7' pos='8 2 1' euler='0 0 30'/>"
        "<geom type='cylinder' size='.5 1' pos='1 1 1'/><geom type='capsule' size='.4 .8' pos='6 "
        "6 2' euler='40 0 0'/>"
        "<geom type='ellipsoid' size='.4 .8 1.2' pos='2 6 2'/></worldbody></mujoco>"
    )
    code, told, said = run(capsys, "world", tmp_path / "w.xml", "-o", tmp_path / "w.glb")
    assert (code, said) == (0, "")
    assert str(tmp_path / "w.glb") in told
    scene = trimesh.load(tmp_path / "w.glb", file_type="glb")
    solids = read_world(tmp_path / "w.xml").solids
    volumes = {
        SPHERE: 4.18879,
        BOX: 1.68,
        CYLINDER: 1.5708,
        CAPSULE: 0.80425 + 0.26808,
        ELLIPSOID: 1.60850,
    }
    lower, upper = solids.boxes
    assert len(scene.geometry) == len(solids)
    for n, shape in enumerate(solids.shape):
        transform, name = scene.graph[f"solid {n}"]
        mesh = scene.geometry[name].copy()
        mesh.apply_transform(transform)
        mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
        np.testing.assert_allclose(mesh.bounds, [lower[n], upper[n]], atol=0.02)
        assert mesh.is_watertight
        assert 0.96 < mesh.volume / volumes[int(shape)] < 1.0001
    ball = scene.geometry[scene.graph["solid 0"][1]]
    assert tuple(
        np.asarray(
            ball.visual.face_colors if ball.visual.kind == "face" else ball.visual.vertex_colors
        )[0][:3]
    ) == (255, 0, 0)
    code, _, said = run(capsys, "world", made, 0, "-o", tmp_path / "d.glb")
    assert (code, said) == (0, "")
    assert (tmp_path / "d.glb").read_bytes().startswith(b"glTF")
    for words, part in (
        ([made, "-o", tmp_path / "x.glb"], "number"),
        ([tmp_path / "w.xml", 0, "-o", tmp_path / "x.glb"], "number"),
        ([tmp_path / "w.xml"], ".glb"),
    ):
        code, _, said = run(capsys, "world", *words)
        assert (code, said.count("\n")) == (2, 1)
        assert part in said
