"""What is written in another format, an independent reader finds again."""

import dataclasses
import json
import sys

import h5py
import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal

import scenegen
from lidarsim.engines.voxels import FREE, OCCUPIED
from scenegen.convert import Choices
from scenegen.convert.convert import convert
from scenegen.convert.formats import SemanticKitti
from scenegen.convert.recordings import rerun as import_rerun
from scenegen.dataset.read import Dataset
from scenegen.draw.source import read_world
from scenegen.worlds.place import parse_octomap
from tests.command_line import beside, done, python, refused, run
from tests.conftest import contents
from tests.refusals import refuses
from tests.scenegen import cases
from tests.scenegen.test_moving_samples import moving as moving  # a fixture
from tests.test_silence import environment, noted, shim  # noqa: F401 (shim is a fixture)

MASKS = ("observed", "free", "occupancy")


def converted(made, out, to, split="val", **choices):
    convert(Dataset(made), out, to=to, choices=Choices(**choices), splits=(split,))
    return out


def samples_of(made):
    """The samples that `converted` writes, each with its number in names of files."""
    for number, sample in enumerate(Dataset(made).split("val")):
        yield f"{number:06d}", sample


def unpacked(content, shape):
    """Bits as the development kit unpacks them: the first voxel is the highest."""
    bits = np.unpackbits(np.frombuffer(content, np.uint8))
    return bits[: np.prod(shape)].reshape(shape)


@pytest.mark.parametrize("to", ["npz", "occ3d"])
def test_the_future_of_movers(moving, tmp_path, to):
    files = converted(moving, tmp_path / "out", to, split="train", future=True).rglob("*.npz")
    for path, sample in zip(sorted(files), Dataset(moving).split("train"), strict=True):
        motion, flow = sample.motion, sample.motion.flow()
        later = {f"occupancy+{after_s}": motion.occupancy(after_s) for after_s in (0.5, 1, 2)}
        expected = {"flow": flow[..., :2]} if to == "occ3d" else {"flow": flow, **later}
        arrays = np.load(path)
        for name, values in expected.items():
            assert_array_equal(arrays[name], values)


def test_without_movers_there_is_no_future(made, tmp_path):
    refuses("--future", converted, made, tmp_path / "out", "npz", future=True)


@pytest.mark.parametrize("unseen", [False, True])
def test_semantickitti(made, tmp_path, unseen):
    out = converted(made, tmp_path / "out", "semantickitti", unseen_invalid=unseen)
    for number, sample in samples_of(made):
        stem = out / f"sequences/08/voxels/{number}"
        unknown = ~(sample.observed | sample.free)
        masks = {".bin": sample.observed, ".invalid": unknown & unseen, ".occluded": unknown}
        for suffix, mask in masks.items():
            assert_array_equal(unpacked(stem.with_suffix(suffix).read_bytes(), mask.shape), mask)
        labels = np.fromfile(stem.with_suffix(".label"), np.uint16)
        assert_array_equal(labels, 50 * sample.occupancy.ravel())
    known = np.arange(unknown.size).reshape(unknown.shape) % 3 > 0  # as of a real place
    place = dataclasses.replace(sample, known=known)
    invalid = SemanticKitti(Choices()).encode(place, Dataset(made).grid, Dataset(made).lidar)[2]
    assert_array_equal(unpacked(invalid, known.shape), ~known)


def test_semantickitti_s_splits_are_dealt_to_all_of_their_sequences():
    """In its own lists, 08 is for validation, those before and up to 10 for training."""
    form = SemanticKitti(Choices())
    sequences = {"train": {*range(11)} - {8}, "val": {8}, "test": {*range(11, 22)}}
    for split, expected in sequences.items():
        assert {int(form.names(split, n)[0].split("/")[1]) for n in range(22)} == expected


def test_occ3d(made, tmp_path):
    """Arrays as the loaders of Occ3D-nuScenes take them from `labels.npz`: free voxels are 17."""
    out = converted(made, tmp_path / "out", "occ3d")
    for number, sample in samples_of(made):
        labels = np.load(out / "gts" / "val" / number / "labels.npz")
        seen = sample.observed | sample.free
        expected = np.where(sample.occupancy, 15, 17), seen, np.ones_like(seen)
        for name, values in zip(("semantics", "mask_lidar", "mask_camera"), expected, strict=True):
            assert labels[name].dtype == np.uint8
            assert_array_equal(labels[name], values)


OCC3D_NAMES = [name for (name,) in cases("convert/occ3d")]
OURS, SEMANTIC_KITTI, OCC3D = zip(*cases("convert/classes"), strict=True)


@pytest.fixture(scope="module")
def labelled(tmp_path_factory):
    """A dataset of a world with a box of each class, and the classes of its voxels: read with h5py
    and json alone."""
    folder = tmp_path_factory.mktemp("labelled")
    document, names = "<mujoco><asset>", OURS[1:]
    document += "".join(f'<material name="{name}"/>' for name in names) + "</asset><worldbody>"
    for n, name in enumerate(names):
        place = f'size=".4 .4 .4" pos="{2 * (n % 4)} {2 * (n // 4)} 0.5"'
        document += f'<geom type="box" {place} material="{name}"/>'
    (folder / "town.xml").write_text(f"{document}</worldbody></mujoco>")
    options = {"n": 2, "val": 0, "test": 0, "labels": "class", "out": folder / "d"}
    scenegen.generate(scene=folder / "town.xml", **options)
    parts = json.loads((folder / "d/dataset.json").read_text())["recipe"]["parts"]
    with h5py.File(folder / "d/train-00000.h5") as file:
        classes = np.array(parts["labels"]["classes"])[file["voxel_class"][:]]
    assert set(OURS) == set(np.unique(classes))
    return folder / "d", classes


@pytest.mark.parametrize("to", ["semantickitti", "occ3d", "npz"])
def test_classes_become_the_formats_by_name(labelled, tmp_path, to):
    dataset, classes = labelled
    converted(dataset, tmp_path, to, split="train", label=60)
    for n, expected in enumerate(classes):
        if to == "semantickitti":
            numbers = np.fromfile(tmp_path / f"sequences/0{n}/voxels/00000{n}.label", np.uint16)
            written, theirs = numbers.astype(str), SEMANTIC_KITTI
        elif to == "occ3d":
            numbers = np.load(tmp_path / f"gts/train/00000{n}/labels.npz")["semantics"]
            written, theirs = np.array(OCC3D_NAMES)[numbers], OCC3D
        else:
            arrays = np.load(tmp_path / f"train/00000{n}.npz", allow_pickle=False)
            written, theirs = arrays["classes"][arrays["voxel_class"]], OURS
        renamed = dict(zip(OURS, theirs, strict=True))
        assert written.ravel().tolist() == [renamed[name] for name in expected.ravel()]


def test_names_that_a_format_lacks_are_told(labelled, tmp_path, capsys):
    command = f"convert {labelled[0]} --to semantickitti -o {tmp_path}/k"
    code, _, notes = run(capsys, f"{command} --label 60")
    (line,) = (line for line in notes.splitlines() if "classes" in line)
    told, _, lacking = line.partition(": ")
    assert (code, told) == (0, "classes that the format lacks become 60")
    assert set(OURS) & set(lacking.split(", ")) == {"machine"}


PCD = beside(__file__, "head.pcd")
"""As https://pointclouds.org/documentation/tutorials/pcd_file_format.html says."""


@pytest.mark.parametrize("frame", ["body", "world"])
def test_clouds(made, tmp_path, frame):
    for to in ("ply", "pcd", "npz"):
        converted(made, tmp_path / to, to, frame=frame)
    for number, sample in samples_of(made):
        place, expected = "0 0 0", sample.points(frame=frame)
        single = expected.astype("<f4")
        assert len(expected)
        assert_array_equal(trimesh.load(tmp_path / f"ply/val/{number}.ply").vertices, single)
        if frame == "world":
            place = "{} {} {}".format(*sample.position)
        content = PCD.format(n=len(single), place=place).encode() + single.tobytes()
        assert (tmp_path / f"pcd/val/{number}.pcd").read_bytes() == content
        with np.load(tmp_path / f"npz/val/{number}.npz", allow_pickle=False) as arrays:
            assert_array_equal(arrays["points"], expected)
            for name in sample.names:
                assert_array_equal(arrays[name], getattr(sample, name))


def test_octomap(made, tmp_path):
    """Cells are multiples of the voxel: a map moves by up to half a voxel."""
    out = converted(made, tmp_path / "out", "octomap")
    voxel_m = Dataset(made).grid.voxel_m
    for number, sample in samples_of(made):
        tree = parse_octomap((out / f"val/{number}.bt").read_bytes(), "")
        assert tree.voxel_m == voxel_m
        for state, mask in ((OCCUPIED, sample.observed), (FREE, sample.free & ~sample.observed)):
            places = np.argwhere(tree.states == state) * voxel_m + tree.bounds[0]
            moved = places - np.argwhere(mask) * voxel_m - sample.origin
            assert len(places)
            assert np.abs(moved).max() <= voxel_m / 2 + 1e-6


def test_a_stopped_conversion_goes_on(made, tmp_path, monkeypatch):
    monkeypatch.setattr("scenegen.convert.convert.CHUNK", 1)
    to, out = "semantickitti", tmp_path / "out"

    def go_on(**options):
        ended = convert(Dataset(made), out, to=to, choices=Choices(), splits=("val",), **options)
        return ended.written, ended.existing

    def stop(count):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        go_on(on_done=stop)
    next(out.rglob("*.invalid")).unlink()  # as if stopped within the first sample
    assert go_on() == (2, 0)
    assert go_on() == (0, 2)
    assert contents(converted(made, tmp_path / "whole", to)) == contents(out)
    for other, choices in ((to, {"label": 70}), ("ply", {})):
        refuses(other, converted, made, out, other, **choices)
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ModuleNotFoundError):
        converted(made, tmp_path / "lost", "rerun")
    assert not (tmp_path / "lost").exists()


def test_what_cannot_be_read_is_named_and_the_rest_is_written(dataset, tmp_path, capsys):
    first, lost = dataset / "train-00000.h5", dataset / "train-00001.h5"
    sound, moved = first.read_bytes(), lost.rename(tmp_path / "moved")
    with h5py.File(first, "r+") as shard:
        shard["position"][1] += 0.05
        stored = shard["tudf"].id  # which has no part in the digest
        stored.write_direct_chunk((2, 0, 0, 0), bytes(stored.get_chunk_info(2).size))
    command = f"convert {dataset} --split train --quiet -o {tmp_path}"
    shared, tar = f"{command}/tar --to webdataset", tmp_path / "tar" / "train-000000.tar"
    again = shared, [1, 2, 3, 4, 5]
    for words, broken in ((f"{command}/pcd --to pcd", [1, 3, 4, 5]), again, again):
        code, _, notes = run(capsys, words)
        assert code == 1
        assert [n for n in range(11) if f"train {n} is left out" in notes] == broken
        assert f"{len(broken)} samples could not be read" in notes
    assert len(list(tmp_path.rglob("*.pcd"))) == 7
    assert tar.read_bytes().count(b".npz\0") == 6
    first.write_bytes(sound)
    moved.rename(lost)
    done(capsys, shared)
    assert tar.read_bytes().count(b".npz\0") == 11


def test_a_format_of_ones_own(made, tmp_path, monkeypatch, capsys):
    (tmp_path / "my_format_of_tests.py").write_text(
        "class Counts:\n    def __init__(self, choices): pass\n    def names(self, split, "
        "number): return (f'{split}-{number}.txt',)\n    def encode(self, sample, grid, lidar): "
        "return (str(sample.occupancy.sum()).encode(),)\n"
    )
    monkeypatch.chdir(tmp_path)
    done(capsys, f"convert {made} --to my_format_of_tests:Counts -o out --quiet")
    for number, sample in enumerate(Dataset(made).split("test")):
        assert int((tmp_path / f"out/test-{number}.txt").read_text()) == sample.occupancy.sum()


def test_webdataset_s_own_loader_finds_every_sample(made, tmp_path, monkeypatch):
    webdataset = pytest.importorskip("webdataset", reason="webdataset is not installed")
    monkeypatch.setattr("scenegen.convert.formats.WebDataset.together", 2)
    out, again = (converted(made, tmp_path / name, "webdataset") for name in ("out", "again"))
    shards = sorted(map(str, out.glob("val-*.tar")))
    expected = dict(samples_of(made))
    assert len(shards) == -(-len(expected) // 2)
    rows = webdataset.WebDataset(shards, shardshuffle=False).decode()
    for row, (number, sample) in zip(rows, expected.items(), strict=True):
        assert (row["__key__"], row["json"]["world"]) == (number, sample.world)
        for name in (*MASKS, "tudf"):
            assert_array_equal(row["npz"][name], getattr(sample, name))
    assert contents(out) == contents(again)


RERUN = """
import os, sys
sys.argv = ["scenegen", "convert", sys.argv[1], "--to", "rerun", "-o", sys.argv[2], "--quiet"]
os.environ["FORCE_RERUN_ANALYTICS"] = "1"
class Watch:
    def find_spec(self, name, path=None, target=None):
        if name == "rerun":
            names = ("FORCE_RERUN_ANALYTICS", "CI", "TELEMETRY_ENABLED")
            assert [os.environ.get(key) for key in names] == [None, "true", "false"]
            print("watched")
sys.meta_path.insert(0, Watch())
from scenegen.__main__ import main
main()
"""


def test_rerun_s_own_reader_finds_every_sample_and_nothing_is_reported(
    made,
    tmp_path,
    shim,  # noqa: F811
    monkeypatch,
):
    pytest.importorskip("rerun_bindings", reason="rerun-sdk is not installed")
    variables = environment(shim, tmp_path)
    assert "watched" in python("-c", RERUN, made, tmp_path / "out", env=variables).stdout
    assert noted(tmp_path) == []
    assert list((tmp_path / "home").rglob("*.json")) == []
    for name in ("CI", "TELEMETRY_ENABLED"):
        monkeypatch.setenv(name, "")  # so that it is put back
    import_rerun()
    from rerun.chunk import RrdReader

    dataset = Dataset(made)
    samples, seen = dataset.split("val"), set()
    readers = [RrdReader(path) for path in sorted((tmp_path / "out").glob("*.rrd"))]
    assert len({reader.recordings()[0].recording_id for reader in readers}) == 3
    reader = readers[-1]
    layout = reader.stream(store=reader.blueprints()[0])
    shown = [chunk.to_record_batch().to_pydict() for chunk in layout]
    assert "['/occupancy', '/sensor']" in str(shown)
    for chunk in reader.stream():
        if (name := chunk.entity_path.strip("/")) not in (*MASKS, "scan"):
            continue
        batch = chunk.to_record_batch()
        columns = (batch[key].to_pylist() for key in ("sample", "Points3D:positions"))
        for number, points in zip(*columns, strict=True):
            seen.add((number, name))
            sample = samples[number]
            centres = dataset.grid.centres(sample.origin)
            expected = sample.points() if name == "scan" else centres[getattr(sample, name)]
            assert_array_equal(np.array(points, np.float32), expected.astype(np.float32))
    assert seen == {(n, name) for n in range(len(samples)) for name in (*MASKS, "scan")}


SHAPES = beside(__file__, "shapes.xml")
VOLUMES = 1.07233, 1.5708, 1.60850, 1.68, 4.18879
"""Cubic metres, from the least: capsule, cylinder, ellipsoid, box and sphere."""


def test_a_world_s_surfaces_are_where_its_solids_are(made, tmp_path, capsys):
    """Of every shape, against another reader of meshes' volumes and bounds; y is up there."""
    document, surfaces = tmp_path / "w.xml", tmp_path / "w.glb"
    document.write_text(SHAPES)
    done(capsys, f"world {document} -o {surfaces}")
    scene = trimesh.load(surfaces)
    solids = read_world(document).solids
    volumes = []
    for n, bounds in enumerate(zip(*solids.boxes, strict=True)):
        transform, name = scene.graph[f"solid {n}"]
        mesh = scene.geometry[name].copy().apply_transform(transform)
        mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
        assert_allclose(mesh.bounds, bounds, atol=0.02)
        assert mesh.is_watertight
        volumes.append(mesh.volume)
    # flat triangles within a round solid hold up to 4 % less, and none holds more
    assert_allclose(np.sort(volumes) / VOLUMES, 0.98, atol=0.0201)
    for words in (made, f"{document} 0"):
        assert "number" in refused(capsys, f"world {words} -o {tmp_path}/x.glb")
