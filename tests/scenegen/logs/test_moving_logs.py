"""Logs of worlds with movers: boxes and labels are read by code of its own, and hold the points of
their movers."""

import dataclasses
import itertools
import json
import math
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

from lidarsim import AnalyticEngine
from lidarsim.noise.chain import Noise
from scenegen.draw.source import named_world
from scenegen.logs import Cruise
from scenegen.logs.record import (
    cruise_poses,
    matrix_of,
    out_of_the_way,
    period_s,
    record,
    write_log,
)
from scenegen.worlds.tables import named_lidar
from tests.command_line import done
from tests.scenegen.logs.conftest import ROOM, SENSOR

CLASSES = {"Pedestrian": 254, "Car": 252, "Misc": 259}


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A world with movers, a sensor, and a flight."""
    folder = tmp_path_factory.mktemp("moving")
    (folder / "room.xml").write_text(ROOM)
    (folder / "mine.toml").write_text(SENSOR)
    sensor = named_lidar(str(folder / "mine.toml"))
    world = named_world(str(folder / "room.xml"), 3, movers="dense")
    poses = cruise_poses(world, Cruise(length_m=6), period_s(sensor), seed=3)
    return out_of_the_way(world, poses, period_s(sensor)), sensor, poses


def recorded(flown, noise="none", **more):
    world, sensor, poses = flown
    return record(world, AnalyticEngine.of, sensor, poses, Noise.parse(noise), seed=0, **more)


def in_world(points, pose):
    return points @ matrix_of(pose)[:3, :3].T + pose.position


def check_held(own, points, middle, yaw, size):
    """A mover's own points (n,) of all (n, 3) are those in its upright box."""
    x, y, z = (points - middle).T
    along, aside = math.cos(yaw) * x + math.sin(yaw) * y, math.cos(yaw) * y - math.sin(yaw) * x
    beyond_m = (np.abs([along, aside, z]).T - np.array(size) / 2).max(axis=1)
    assert (beyond_m[own] <= 1e-4).all()
    assert own[beyond_m <= -1e-4].all()


def test_boxes_of_a_folder_hold_the_points_of_their_track(flown, tmp_path):
    write_log(tmp_path / "log", recorded(flown))
    seen = 0
    for line in (tmp_path / "log" / "label_02.txt").read_text().splitlines():
        frame, track, kind, *numbers = line.split()
        high, wide, long, x, y, z, yaw = map(float, numbers[7:])
        points = np.fromfile(tmp_path / f"log/velodyne/{frame:0>6}.bin", "<f4").reshape(-1, 4)
        labels = np.fromfile(tmp_path / f"log/labels/{frame:0>6}.label", "<u4")
        assert set(np.unique(labels[labels >> 16 == 0])) == {99}
        own = labels >> 16 == int(track)
        assert (labels[own] & 0xFFFF == CLASSES[kind]).all()
        check_held(own, points[:, :3], (x, y, z + high / 2), yaw, (long, wide, high))
        seen += np.count_nonzero(own)
    assert seen > 500


def test_markers_of_a_recording_hold_the_points_of_their_id(flown, tmp_path, ros):
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    write_log(tmp_path / "log.mcap", recorded(flown))
    messages = defaultdict(list)
    with open(tmp_path / "log.mcap", "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            messages[channel.topic].append(message)
    for pose, cloud, boxes in zip(flown[2], messages["/points"], messages["/movers"], strict=True):
        offsets = {field.name: field.offset for field in cloud.fields}
        rows = np.frombuffer(bytes(cloud.data), np.uint8).reshape(-1, cloud.point_step)
        points = in_world(rows[:, :12].copy().view("<f4"), pose)
        track = rows[:, offsets["mover"] :][:, :2].copy().view("<u2")[:, 0]
        for box in boxes.markers:
            place, turn, scale = box.pose.position, box.pose.orientation, box.scale
            middle, size = (place.x, place.y, place.z), (scale.x, scale.y, scale.z)
            assert box.header.frame_id == "map"
            check_held(track == box.id, points, middle, 2 * math.atan2(turn.z, turn.w), size)


def test_with_moving_each_point_is_on_its_mover_at_its_time(flown):
    """And the others are on none."""
    movers, found = flown[0].movers, 0
    for scan in itertools.islice(recorded(flown, moving=True, corrected=True), 0, None, 8):
        tracks, times = scan.more["mover"], scan.more["t"]
        for point, track, t in zip(in_world(scan.points, scan.pose), tracks, times, strict=True):
            gaps = movers.gaps_m(point, scan.time_s + float(t))
            assert gaps[track - 1] < 1e-3 if track else gaps.min() > 0
        for box in scan.boxes:
            own = times[tracks == box.track]
            assert box.time_s == pytest.approx(scan.time_s + (own.mean() if len(own) else 0))
        found += np.count_nonzero(tracks)
    assert found > 50


def test_noise_moves_no_point_to_another_mover(flown):
    clean, noisy = (
        np.concatenate([scan.more["mover"] for scan in recorded(flown, noise)])
        for noise in ("none", "range:0.02")
    )
    assert len(clean) == len(noisy)
    assert (clean == noisy).mean() > 0.9999


def test_no_mover_comes_near_the_sensor(flown):
    world, sensor, poses = flown
    for number, pose in enumerate(poses):
        assert world.movers.gaps_m(pose.position, number * period_s(sensor)).min() > 0.5


def test_a_recorded_log_tells_of_its_movers(standing, capsys):
    words = "scan pillar --seed 2 --movers light --flight --sequence --length 2 --json"
    facts = json.loads(done(capsys, f"{words} --lidar velodyne-vlp-16 -o log"))
    tracks = {line.split()[1] for line in Path("log/label_02.txt").read_text().splitlines()}
    assert len(tracks) == facts["movers"] > 0
    assert len([*Path("log/labels").iterdir()]) == facts["scans"]


def test_logs_of_standing_worlds_have_no_labels(flown, tmp_path):
    world = dataclasses.replace(flown[0], movers=None)
    (scan,) = record(world, AnalyticEngine.of, flown[1], flown[2][:1], Noise(), seed=0)
    write_log(tmp_path / "log", [scan])
    assert not (tmp_path / "log" / "labels").exists()
