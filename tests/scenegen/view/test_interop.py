"""The recipes of docs/convert.md do what they say."""

import io
import re
import sys
from dataclasses import make_dataclass
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import scenegen
from scenegen.dataset.read import Dataset
from tests.command_line import ROOT

PAGE = (ROOT / "docs" / "convert.md").read_text(encoding="utf-8")
(BATCHES,) = re.findall(r"^```python\n(.*?)^```\n", PAGE, re.M | re.S)
NODE = (ROOT / "docs" / "ros_scanner.py").read_text(encoding="utf-8")
SCENE = """<mujoco><worldbody>
<geom type="plane" size="9 9 1"/><geom type="box" size="1 1 9" pos="4 0 0"/>
<body name="robot" pos="0 0 3"><freejoint/><geom type="sphere" size=".2"/></body>
</worldbody></mujoco>"""


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


def test_the_ros_node_publishes_what_the_definitions_say(tmp_path, monkeypatch):
    pytest.importorskip("mcap_ros2")
    from mcap_ros2.writer import Writer

    from scenegen.logs.bags import CLOUD, DEFINITIONS

    sent = []
    kinds = {}
    for text in f"MSG: sensor_msgs/PointCloud2\n{DEFINITIONS[CLOUD]}".split("MSG: ")[1:]:
        name, *fields = re.findall(r"^\S+[/ ](\w+)$", text, re.M)
        kinds[name] = make_dataclass(name, [(field, Any, None) for field in fields])
    now = SimpleNamespace(to_msg=lambda: kinds["Time"](sec=7, nanosec=5))
    node = SimpleNamespace(
        get_clock=lambda: SimpleNamespace(now=lambda: now),
        create_publisher=lambda *about: SimpleNamespace(publish=sent.append),
        create_timer=lambda period, call: call(),
    )
    rclpy = {"init": lambda: None, "create_node": lambda name: node, "spin": lambda node: None}
    messages = {f"{name}.msg": kinds for name in ("sensor_msgs", "std_msgs")}
    for name, held in {"rclpy": rclpy, "sensor_msgs": {}, "std_msgs": {}, **messages}.items():
        module = ModuleType(name)
        module.__dict__.update(held)
        monkeypatch.setitem(sys.modules, name, module)
    (tmp_path / "scene.xml").write_text(SCENE)
    monkeypatch.setattr(sys, "argv", ["node.py", str(tmp_path / "scene.xml"), "robot"])
    names = {}
    exec(NODE, names)
    writer = Writer(io.BytesIO())  # which takes what has all the fields of the definitions
    writer.write_message("/points", writer.register_msgdef(CLOUD, DEFINITIONS[CLOUD]), sent[0])
    points = np.frombuffer(sent[0].data, "<f4").reshape(-1, 3)
    assert (sent[0].header.stamp.sec, sent[0].header.frame_id) == (7, "lidar")
    ranges = names["lidar"].scan(names["data"]).ranges
    ranges = ranges[np.isfinite(ranges)]
    assert_allclose(np.linalg.norm(points, axis=1), ranges, rtol=1e-6)
