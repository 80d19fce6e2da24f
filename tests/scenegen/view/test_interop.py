"""The recipes of docs/convert.md do what they say."""

import re
import sys
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import scenegen
from scenegen.dataset.read import Dataset
from tests.command_line import beside, page

(BATCHES,) = re.findall(r"^```python\n(.*?)^```\n", page("convert.md"), re.M | re.S)
NODE = page("ros_scanner.py")
SCENE = beside(__file__, "robot.xml")


def test_sparse_batches_hold_every_observed_voxel(made):
    pytest.importorskip("torch")
    names = {}
    exec(BATCHES, names)
    samples = Dataset(made).split("train")
    batch = scenegen.collate(samples[:3])
    numbers, *cells = batch["coordinates"].numpy().T
    observed = np.zeros(batch["occupancy"].shape, bool)
    observed[numbers, *cells] = True
    assert_array_equal(observed, [sample.observed for sample in samples[:3]])
    assert len(batch["features"]) == observed.sum()
    dense = list(names["batches"](samples, 3))
    assert len(dense) == len(samples) // 3
    assert_array_equal(dense[0][0], observed)


def test_the_ros_node_publishes_what_it_scans(tmp_path, monkeypatch):
    """Under names of messages that test_logs.py reads."""
    ros = MagicMock(**dict.fromkeys(("PointCloud2", "PointField", "Header"), SimpleNamespace))
    for name in ("rclpy", "sensor_msgs", "sensor_msgs.msg", "std_msgs", "std_msgs.msg"):
        monkeypatch.setitem(sys.modules, name, ros)
    node = ros.create_node.return_value
    node.create_timer = lambda period, call: call()
    (tmp_path / "scene.xml").write_text(SCENE)
    monkeypatch.setattr(sys, "argv", ["node.py", str(tmp_path / "scene.xml"), "robot"])
    names = {}
    exec(NODE, names)
    ((cloud,), _) = node.create_publisher.return_value.publish.call_args
    assert [field.name for field in cloud.fields] == ["x", "y", "z"]
    points = np.frombuffer(cloud.data, "<f4").reshape(-1, 3)
    assert cloud.header.frame_id == "lidar"
    assert cloud.header.stamp is node.get_clock.return_value.now.return_value.to_msg.return_value
    ranges = names["lidar"].scan(names["data"]).ranges
    assert_allclose(np.linalg.norm(points, axis=1), ranges[np.isfinite(ranges)], rtol=1e-6)
