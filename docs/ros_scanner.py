"""A ROS 2 node that steps a MuJoCo scene and publishes what a LiDAR on one of its bodies sees.

    python docs/ros_scanner.py scene.xml robot    # a sourced ROS 2, and scenegen in the same Python

PointCloud2 on /points, in the frame `lidar`. Each call of `scan` steps the simulation by the period
of the timer, so that it keeps pace with the clock where the machine does.
"""

import sys

import mujoco
import numpy as np
import rclpy
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

from lidarsim import Lidar, attach
from scenegen.logs.bags import points_message

scene, body, rate_hz = sys.argv[1], sys.argv[2], 10.0
model = mujoco.MjModel.from_xml_path(scene)
data = mujoco.MjData(model)
lidar = attach(model, body, Lidar())
rclpy.init()
node = rclpy.create_node("scanner")
clouds = node.create_publisher(PointCloud2, "points", 10)


def scan() -> None:
    """Step the scene, and publish a scan."""
    mujoco.mj_step(model, data, round(1 / (rate_hz * model.opt.timestep)))
    seen = lidar.scan(data)
    hit = np.isfinite(seen.ranges)
    points = seen.ranges[hit, None] * seen.lidar.directions_body[hit]
    header = Header(stamp=node.get_clock().now().to_msg(), frame_id="lidar")
    values = points_message(points, header)
    values["fields"] = [PointField(**field) for field in values["fields"]]
    clouds.publish(PointCloud2(**values))


node.create_timer(1 / rate_hz, scan)
rclpy.spin(node)
