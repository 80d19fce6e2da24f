"""A sensor of a running simulation, shown in a browser while it runs."""

import json
import re
import threading
import webbrowser
from collections.abc import Sequence
from http import HTTPStatus
from types import SimpleNamespace
from typing import Any

import numpy as np

from lidarsim.attachment import Attached
from lidarsim.solids import ModelSolids
from scenegen.base.errors import DatasetError
from scenegen.view.look import field_of_view
from scenegen.view.page import FETCHES, PageServer, Reply, filled, packed_world

PLANE_M = 10.0
"""Least reach of a plane that is drawn, metres."""
SCAN = re.compile(r"/scan/([0-9]{1,15})")
WAIT_S = 5.0
"""How long a request waits for a new scan, seconds."""


class LiveView(PageServer):
    """A page that shows the newest scan of a running simulation, and the solids where they are.

    The simulation never waits: scans are packed in the server's thread when the browser asks for
    one, and those that came meanwhile are dropped.

        with scenegen.view_live(lidar) as viewer:
            while True:
                mujoco.mj_step(model, data, 20)
                scans = viewer.update(data)

    Attributes:
        address: Address for the browser.
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
                "view_live: expected a sensor of a simulation, such as lidarsim.attach(model, body)"
            )
        content = {"title": "live", "notes": [], "stream": {"fov": field_of_view(sensor.sensor)}}
        super().__init__(filled(content, (), FETCHES, "live.js"), host=host, port=port)
        self.sensor, self._number = sensor, 0
        self._newer = threading.Condition()
        # a daemon: a program that never calls `close` still ends
        threading.Thread(target=self.serve_forever, daemon=True).start()
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
        scans = scans or self.sensor.scans(data)
        poses = [[*pose.position, *pose.quaternion] for pose in self.sensor.poses(data)]
        # copied: the simulation goes on while the browser asks
        places = np.hstack([data.geom_xpos, data.geom_xmat]).astype("<f4")
        # geoms never change their shape: later scans bring only their places
        if not self._number:
            self._solids = ModelSolids(self.sensor.model).at(data), places
        with self._newer:
            self._moment = data.time, scans, np.array(poses), places
            self._number += 1
            self._newer.notify_all()  # several pages may wait
        return scans

    def close(self, *error: object) -> None:
        """End the page."""
        self.shutdown()
        self.server_close()

    __exit__ = close

    def reply(self, path: str) -> Reply | None:
        """Answer /scan/N with the newest scan after number N, and /solids, see
        `PageServer.reply`."""
        if path == "/solids" and self._number:
            content = _packed_solids(*self._solids)
        elif request := SCAN.fullmatch(path):
            with self._newer:
                newer = self._newer.wait_for(lambda: self._number > int(request[1]), WAIT_S)
                moment = (self._number, *self._moment) if newer else ()
            # empty: nothing came for a while, and the page asks again
            content = _packed_scan(*moment) if moment else b""
        else:
            return None
        return HTTPStatus.OK, "application/octet-stream", content


def _packed_scan(number: int, time_s: float, scans: Any, poses: Any, places: Any) -> bytes:
    """Encode a scan: the length of the header, 4 bytes; the header, JSON; places of geoms
    (ngeom, 12), float32; returns around the first sensor (n, 4), int16: x, y, z, 32767 for the
    farthest, and 0."""
    # from the first sensor, so that 16 bits resolve a scan wherever in the world it is
    points = np.concatenate([scan.points() for scan in scans]) - poses[0, :3]
    reach = float(np.abs(points).max(initial=1e-6))  # never 0, by which points are divided
    # single far returns would make all others one colour
    # the 0 is for scans without returns, which have no quantiles
    heights = np.quantile(np.append(points[::16, 2], 0.0), [0.02, 0.98]) + poses[0, 2]
    head = {
        "number": number,
        "time": time_s,
        "reach": reach,
        "heights": heights.tolist(),
        "points": len(points),
        "sensors": poses.tolist(),
    }
    text = json.dumps(head).encode()
    text += b" " * (-len(text) % 4)  # arrays begin at multiples of four bytes
    # four numbers a point: graphics cards do not read three of two bytes
    numbers = np.zeros((len(points), 4), "<i2")
    numbers[:, :3] = np.rint(points * (32767 / reach))
    return len(text).to_bytes(4, "little") + text + places.tobytes() + numbers.tobytes()


def _packed_solids(solids: Any, places: Any) -> bytes:
    """Encode the surfaces of solids: all triangles, how many numbers each geom has, and where geoms
    are."""
    from scenegen.view.glb import surfaces

    # `surfaces` takes the reach of planes from flight bounds, which a running model does not have
    near: Any = SimpleNamespace(solids=solids, flight_bounds=solids.position + PLANE_M)
    meshes = surfaces(near)
    sizes = [mesh.triangles.size for mesh in meshes]
    facts = {"geoms": solids.geom.tolist(), "sizes": sizes, "places": places.tolist()}
    # there is no map, so corners are in the world's frame
    return json.dumps(facts | packed_world(meshes, np.zeros(3))).encode()


view_live = LiveView
"""The class as a verb: ``with view_live(sensor) as viewer``."""
