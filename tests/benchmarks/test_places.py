"""Recordings of real places become poses and points: level, aligned, and in the right hand."""

import importlib

import numpy as np
import pytest
from PIL import Image

from lidarsim.engines.voxels import FREE, OCCUPIED
from tests.command_line import ROOT


@pytest.fixture
def places(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    return importlib.import_module("places")


def in_world(seen):
    return np.concatenate([points @ pose[:3, :3].T + pose[:3, 3] for pose, points in seen])


def test_a_floor_seen_from_above_is_level(tmp_path, places):
    focal, tilt, height = 585.0, np.radians(25), 1.4
    camera, frame = tmp_path / "camera-intrinsics.txt", tmp_path / "frame-000000.depth.png"
    camera.write_text(f"{focal} 0 320\n0 {focal} 240\n0 0 1\n")
    down = (np.arange(480) - 240) / focal
    # of a camera that looks down by the tilt, x right, y down and z forward
    sinking = np.sin(tilt) + down * np.cos(tilt)
    depth = np.where(sinking > 0.1, height / np.maximum(sinking, 0.1), 0)
    picture = np.repeat(1000 * depth[:, None], 640, axis=1).astype(np.uint16)
    Image.fromarray(picture).save(frame)
    pose = tmp_path / "frame-000000.pose.txt"
    pose.write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")

    points = in_world(places.room([frame, pose, camera]))

    assert len(points) > 5000
    assert abs(points[:, 2] + height).max() < 0.05


def test_turns_of_left_handed_axes_are_turned_round(tmp_path, places):
    scan, pose = tmp_path / "scan000.3d", tmp_path / "scan000.pose"
    scan.write_text("0 0 100\n0 50 100\n0 0 3276\n")
    pose.write_text("0 0 200\n0 90 0\n")

    points = in_world(places.laser([scan, pose]))

    # what was ahead is to the right now; what is farther than a scanner sees is left out
    assert np.allclose(points, np.array([[2, -1, 0], [2, -1, 0.5]]), atol=1e-6)


def test_scans_of_a_graph_have_its_poses(tmp_path, places):
    cloud, poses = tmp_path / "points.bin", tmp_path / "graph.txt"
    np.array([[1, 0, 0]], np.float32).tofile(cloud)
    poses.write_text("v0 10 0 2 0 0 0.70710678 0.70710678\n")

    assert np.allclose(in_world(places.graph([cloud, poses])), np.array([[10, 1, 2]]))


def test_points_of_vtk_are_those_after_its_header(tmp_path, places):
    file = tmp_path / "cloud.vtk"
    head = "# vtk DataFile Version 3.0\ndata\nASCII\nDATASET POLYDATA\n"
    file.write_text(f"{head}POINTS 2 float\n1 2 3\n4 5 6\nVERTICES 2 4\n1 0\n1 1\n")

    assert places.points_in(file).tolist() == [[1, 2, 3], [4, 5, 6]]


def test_a_map_is_made_of_files_with_the_bytes_that_were_measured(tmp_path, places, monkeypatch):
    clone = tmp_path / "sources" / "name"
    clone.mkdir(parents=True)
    (clone / "a.xyz").write_text("0.1 0.1 0.1\n")
    (clone / "b.xyz").write_text("0.1 0.1 0.5\n")
    about = {"source": "owner/name", "files": ["*.xyz"], "made": "map --assume-free --voxel 0.2"}
    about["sha256"] = places.digest_of([clone / "a.xyz", clone / "b.xyz"])
    monkeypatch.setattr(places, "PLACES", {"place": about})
    monkeypatch.setattr("sys.argv", ["places.py", str(clone.parent), str(tmp_path / "maps")])

    places.main()

    with np.load(tmp_path / "maps" / "place.npz") as file:
        assert file["states"].tolist() == [[[OCCUPIED, FREE, OCCUPIED]]]
    (clone / "b.xyz").write_text("0.1 0.1 0.6\n")
    with pytest.raises(SystemExit, match="SHA-256"):
        places.main()


def test_every_place_says_what_a_reader_asks(places):
    for name, about in places.PLACES.items():
        assert len(about["sha256"]) == 64
        if "place" in about:
            assert {"what", "sensor", "licence", "lacks"} < about.keys(), name
        how, *words = about["made"].split()
        assert how in ("as", "map") or words[0] in places.READERS, name
