"""A sensor of a running simulation, shown in a browser while it runs."""

import json
import threading
import webbrowser
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from lidarsim.attachment import Attached
from lidarsim.grid import Floats
from lidarsim.parameters import short_repr
from lidarsim.solids import ModelSolids
from scenegen.base.errors import DatasetError
from scenegen.view.look import field_of_view
from scenegen.view.page import PageServer, packed_world, scan_page

WAIT_S = 5.0
"""How long a request waits for a new scan, seconds."""


class LiveView:
    """A page that shows the newest scan of a running simulation, and the solids where they are.

    The simulation never waits: scans are packed in the server's thread when the browser asks for
    one, and those that came meanwhile are dropped.

        with scenegen.view_live(lidar) as viewer:
            while True:
                mujoco.mj_step(model, data, 20)
                scans = viewer.update(data)
    """

    def __init__(
        self, sensor: Attached, *, host: str = "127.0.0.1", port: int = 0, browser: bool = True
    ):
        """Serve the page, and open it.

        Args:
            sensor: From `lidarsim.attach`.
            host: An IP address of this machine, or `localhost`.
            port: The port; 0 for any free one.
            browser: Whether to open a browser on this machine.

        Raises:
            DatasetError: `sensor` is not attached.
            ScenegenError: The address is not one of this machine, or is in use.
        """
        if not isinstance(sensor, Attached):
            raise DatasetError(
                f"view_live({short_repr(sensor)}): expected a sensor of a simulation, such as "
                "lidarsim.attach(model, body)"
            )
        self._server = _ScanServer(sensor, host, port)
        self.address = self._server.address
        """Address for the browser."""
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        if browser:
            webbrowser.open(self.address)

    def update(self, data: Any, scans: Sequence[Any] | None = None) -> Sequence[Any]:
        """Show the simulation as it is now.

        Args:
            data: MuJoCo's data.
            scans: Scans or `Returns` to show, one for each sensor, such as those with noise; None:
                scan now.

        Returns:
            The scans.
        """
        sensor = self._server.sensor
        scans = sensor.scans(data) if scans is None else scans
        poses = [[*pose.position, *pose.quaternion] for pose in sensor.poses(data)]
        # copied: the simulation goes on while the browser asks
        places = np.hstack([data.geom_xpos, data.geom_xmat]).astype("<f4")
        self._server.publish(data, _Moment(float(data.time), scans, np.array(poses), places))
        return scans

    def close(self) -> None:
        """End the page."""
        self._server.shutdown()
        self._server.server_close()

    def __enter__(self) -> "LiveView":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class _Moment(SimpleNamespace):
    """The simulation at a time."""

    def __init__(self, time_s: float, scans: Sequence[Any], poses: Floats, places: Any):
        super().__init__(time_s=time_s, scans=scans, poses=poses, places=places)

    def packed(self, number: int) -> bytes:
        """Return the length of the header, 4 bytes; the header, JSON; places of geoms (ngeom, 12),
        float32; and returns around the first sensor (n, 4), int16: x, y, z, 32767 for the farthest, and 0."""
        points = np.concatenate([scan.points() for scan in self.scans]) - self.poses[0, :3]
        reach = float(np.abs(points).max(initial=1e-6))
        heights = [0.0, 1.0]
        if len(points):  # single far returns would make all others one colour
            heights = (np.quantile(points[::16, 2], [0.02, 0.98]) + self.poses[0, 2]).tolist()
        head = {"number": number, "time": self.time_s, "reach": reach, "heights": heights}
        head |= {"points": len(points), "geoms": len(self.places), "sensors": self.poses.tolist()}
        text = json.dumps(head).encode()
        text += b" " * (-len(text) % 4)  # arrays begin at multiples of four bytes
        # four numbers a point: graphics cards do not read three of two bytes
        numbers = np.zeros((len(points), 4), "<i2")
        numbers[:, :3] = np.rint(points * (32767 / reach))
        return b"".join([len(text).to_bytes(4, "little"), text, self.places, numbers])


class _ScanServer(PageServer):
    """The server of the newest scan."""

    def __init__(self, sensor: Attached, host: str, port: int):
        page = scan_page("live", field_of_view(sensor.sensor))
        super().__init__(page, host=host, port=port)
        self.sensor, self._number, self._solids = sensor, 0, None
        self._newer = threading.Condition()

    def publish(self, data: Any, moment: _Moment) -> None:
        if self._solids is None:
            self._solids = ModelSolids(self.sensor.model).at(data)
        with self._newer:
            self._moment, self._number = moment, self._number + 1
            self._newer.notify_all()

    def binary(self, path: str) -> bytes | None:
        """Answer /scan/N with the newest scan after number N, and /solids."""
        if path == "/solids" and self._solids is not None:
            return _solids(self._solids)
        before = path.removeprefix("/scan/")
        if before == path or not before.isascii() or not before.isdigit():
            return None
        with self._newer:
            if not self._newer.wait_for(lambda: self._number > int(before[:18]), WAIT_S):
                return b""
            moment, number = self._moment, self._number
        return moment.packed(number)


def _solids(solids: Any) -> bytes:
    """Encode the surfaces of solids: all triangles, and how many numbers each geom has."""
    from scenegen.view.glb import surfaces

    finite = solids.position[np.isfinite(solids.position).all(axis=1)]
    meshes = surfaces(SimpleNamespace(solids=solids, flight_bounds=np.abs(finite) + 10.0))
    geoms = [
        [int(geom), mesh.triangles.size] for geom, mesh in zip(solids.geom, meshes, strict=True)
    ]
    return json.dumps({"geoms": geoms} | packed_world(meshes, np.zeros(3))).encode()


view_live = LiveView
"""The class as a verb: ``with view_live(sensor) as viewer``."""
