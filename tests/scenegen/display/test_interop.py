"""The recipes of docs/interop.md do what they say."""

import io
import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from scenegen.dataset.read import Dataset
from tests.command_line import ROOT

PAGE = (ROOT / "docs" / "interop.md").read_text(encoding="utf-8")
SPARSE, BATCHES, NODE = re.findall(r"^```python\n(.*?)^```\n", PAGE, re.M | re.S)
SCENE = """<mujoco><worldbody>
<geom type="plane" size="9 9 1"/><geom type="box" size="1 1 9" pos="4 0 0"/>
<body name="robot" pos="0 0 3"><freejoint/><geom type="sphere" size=".2"/></body>
</worldbody></mujoco>"""


def test_sparse_batches_hold_every_observed_voxel(made: Path) -> None:
    pytest.importorskip("torch")
    names: dict[str, Any] = {}
    exec(SPARSE + BATCHES, names)
    samples = Dataset(made).split("train")
    batch = names["sparse"](samples[:3])
    numbers, *cells = batch["coordinates"].numpy().T
    observed = np.zeros(batch["occupancy"].shape, bool)
    observed[numbers, *cells] = True
    np.testing.assert_array_equal(observed, [sample.observed for sample in samples[:3]])
    assert len(batch["features"]) == observed.sum()
    dense = list(names["batches"](samples, 3))
    assert len(dense) == len(samples) // 3
    np.testing.assert_array_equal(dense[0][0], observed)


def test_the_ros_node_publishes_what_the_definitions_say(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mcap_ros2")
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory
    from mcap_ros2.writer import Writer

    from scenegen.display.exchange.recordings import CLOUD, DEFINITIONS

    sent: list[Any] = []

    class Node:
        def __init__(self, name: str):
            stamp = SimpleNamespace(to_msg=lambda: {"sec": 7, "nanosec": 5})
            self.get_clock = lambda: SimpleNamespace(now=lambda: stamp)
            self.create_publisher = lambda *about: SimpleNamespace(publish=sent.append)
            self.create_timer = lambda period, call: call()

    def cloud() -> SimpleNamespace:
        header = SimpleNamespace(stamp=SimpleNamespace(), frame_id="")
        return SimpleNamespace(header=header)

    messages = {"PointCloud2": cloud, "PointField": SimpleNamespace}
    parts = {"rclpy": {}, "rclpy.node": {"Node": Node}, "sensor_msgs": {}}
    for name, held in {**parts, "sensor_msgs.msg": messages}.items():
        module = ModuleType(name)
        module.__dict__.update(held)
        monkeypatch.setitem(sys.modules, name, module)
    names: dict[str, Any] = {"__name__": "node"}
    exec(NODE, names)
    (tmp_path / "scene.xml").write_text(SCENE)
    node = names["Scanner"](str(tmp_path / "scene.xml"), "robot")
    assert vars(sent[0].header.stamp) == {"sec": 7, "nanosec": 5}
    file = io.BytesIO()
    writer = Writer(file)
    writer.write_message("/points", writer.register_msgdef(CLOUD, DEFINITIONS[CLOUD]), sent[0])
    writer.finish()
    reader = make_reader(io.BytesIO(file.getvalue()), decoder_factories=[DecoderFactory()])
    ((_, _, _, read),) = reader.iter_decoded_messages()
    points = np.frombuffer(read.data, "<f4").reshape(-1, 3)
    scan = node.lidar.scan(node.data)
    assert (read.header.frame_id, read.width) == ("lidar", np.isfinite(scan.ranges).sum())
    np.testing.assert_allclose(
        np.linalg.norm(points, axis=1), scan.ranges[np.isfinite(scan.ranges)], rtol=1e-6
    )
