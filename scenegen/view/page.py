"""The page that shows samples: a file that holds its samples, or a page from a server on this
machine, which reads samples of datasets as the user asks for them.

The server answers ``GET /`` with the page, ``GET /sample/<dataset>/<split>/<index>`` with a sample
as JSON, see `packed`, of the dataset with that number, and ``GET /world/…`` with the sample's
world, if the shard's archive has it. It has no other address, and changes nothing.
"""

import base64
import gzip
import hashlib
import html
import ipaddress
import json
import math
import re
import socket
import socketserver
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from lidarsim.grid import Field, Floats, GridSpec, Mask
from scenegen import SPLITS
from scenegen.base.errors import DatasetError, ScenegenError, printable
from scenegen.base.files import Json
from scenegen.dataset.read import AnyDataset, Split
from scenegen.view.canvas import ON_PAGE, path_colours
from scenegen.view.look import (
    MASKS,
    Guess,
    Guesses,
    Look,
    Timeline,
    incomplete,
    look_into,
    title_of,
)

MAX_VOXELS = 1 << 22
"""Maximum voxels of a grid on a page: a browser needs seconds to make so many cubes."""
MAX_BYTES = 48 << 20
"""Maximum bytes of a page's samples; mail programs and phones refuse larger files."""
HERE = files("scenegen.view")
"""Folder of the page's template and scripts."""


def page(
    looks: Sequence[Look], *, title: str, notes: Sequence[str] = (), film: bool = False
) -> str:
    """Make a page that holds its samples. Names and texts are escaped, and never run as scripts.

    Masks are bits, first voxel highest, in C order; distances are bytes, 255 for the truncation;
    points are int16 from the sensor, 32767 for the farthest coordinate, and the first `own` of them
    are of the sample's own scan. Each array is base64 of gzip.

    Args:
        looks: The samples.
        title: Title of the page.
        notes: Lines for the user.
        film: Whether the samples follow one another in time. The page then has a timeline, and
            opens on what is believed.

    Returns:
        The content of the page, with a note if samples were left out for its size.

    Raises:
        DatasetError: A grid has more than `MAX_VOXELS`.
    """
    samples: list[Json] = []
    notes, size = list(notes), 0
    for look in looks:
        check_grid(look.grid)
        sample = packed(look)
        size += len(json.dumps(sample))
        if size > MAX_BYTES:
            notes.append(
                f"{len(looks) - len(samples)} samples are left out: the page would be too large"
            )
            break
        samples.append(sample)
    # in the order of appearance: colours of methods follow it
    methods = list(dict.fromkeys(guess.name for look in looks for guess in look.guesses))
    masks = list(dict.fromkeys(name for look in looks for name in look.masks))
    curves: Any = film and (looks[0].film or True)
    content = {"title": title, "notes": notes, "samples": samples, "masks": masks, "film": curves}
    return filled(content, methods)


def live_page(datasets: Sequence[Json], *, split: str, index: int, methods: Sequence[str]) -> str:
    """Make the page of the server, which fetches samples one by one.

    Args:
        datasets: Each with its `name`, and `splits`: number of samples by the split's name.
        split: Split of the first dataset that is shown first.
        index: Index of the sample that is shown first.
        methods: Names of the methods that predict.
    """
    live = {"datasets": datasets, "split": split, "index": index}
    title = datasets[0]["name"]
    content = {"title": title, "notes": [], "samples": [], "masks": MASKS, "live": live}
    return filled(content, methods, FETCHES)


FETCHES = "; connect-src 'self'"
"""What a page that fetches from its server adds to the content security policy."""


def filled(content: Json, methods: Sequence[str], policy: str = "", script: str = "page.js") -> str:
    """Fill the template.

    Args:
        content: Data for the script: `title`, `notes`, and what it shows.
        methods: Names of the methods that predict.
        policy: Extends the content security policy.
        script: File of the script.
    """
    colours = list(zip(methods, path_colours(methods), strict=True))
    # still JSON, but no text in it can end the <script> element that holds it
    data = json.dumps({"colours": ON_PAGE, "methods": colours, **content}).replace("<", "\\u003c")
    parts = {
        "TITLE": html.escape(content["title"]),
        "POLICY": policy,
        # it stands in an HTML comment, which must not hold two dashes
        "LICENCE": html.escape(_text("three/LICENSE")).replace("--", "- -"),
        # by the data: equal samples give equal pages, and no text in the data can hold its own hash
        "NONCE": hashlib.sha256(data.encode()).hexdigest()[:32],
        # within the page, so that a file works alone and asks no network
        "THREE": _gzip64((HERE / "three" / "three.module.min.js").read_bytes()),
        "ORBIT": _gzip64((HERE / "three" / "OrbitControls.js").read_bytes()),
        "SCRIPT": _text("stage.js") + _text(script),
        "DATA": data,
    }
    # split once, so that names of parts within the data are not replaced
    pieces = _text("page.html").split("%%")
    return "".join(parts[piece] if n % 2 else piece for n, piece in enumerate(pieces))


def check_grid(grid: GridSpec) -> None:
    """Check that a browser can show a grid.

    Raises:
        DatasetError: It has more than `MAX_VOXELS`.
    """
    if (voxels := math.prod(grid.shape)) > MAX_VOXELS:
        raise DatasetError(
            f"maps of {voxels} voxels; a page shows {MAX_VOXELS} at most; use scenegen render"
        )


def packed(look: Look) -> Json:
    """Encode a sample for the page's script, see `page`."""
    grid, optional = look.grid, dict[str, Any]()
    if look.tudf is not None:
        optional["tudf"] = _distances(look.tudf, grid)
    for name, mask in (("scored", look.scored), ("certain", look.certain)):
        if mask is not None and not mask.all():
            optional[name] = _bits(mask)
    if look.points is not None:
        # from the sensor, so that 16 bits resolve a scan of 100 m to 3 mm
        from_sensor = look.points - look.position
        reach = float(np.abs(from_sensor).max(initial=1e-6))
        packed = _gzip64(np.rint(from_sensor / reach * 32767).astype("<i2").tobytes())
        optional |= {"points": packed, "reach": reach, "own": len(look.scans[0])}
    if look.classes is not None:
        numbers, names = look.classes
        optional["classes"] = {"names": names, "voxels": _gzip64(numbers.astype("<u2").tobytes())}
    if look.surfaces:
        optional |= packed_world(look.surfaces, look.origin)
    if look.timeline is not None:
        optional["movers"] = _packed_movers(look.timeline)
    return {
        "name": look.name,
        "sensor": look.has_sensor,
        "shape": list(grid.shape),
        "voxel": grid.voxel_m,
        "truncation": grid.truncation_m,
        "origin": look.origin.tolist(),
        "position": look.position.tolist(),
        "quaternion": np.round(look.quaternion, 6).tolist(),
        "fov": look.fov_deg,
        "figures": look.figures(),
        "missing": list(look.missing),
        "masks": {name: _bits(mask) for name, mask in look.masks.items()},
        "guesses": [_packed_guess(guess, look) for guess in look.guesses],
        **optional,
    }


def packed_world(surfaces: Sequence[Any], origin: Floats) -> Json:
    """Encode the surfaces of a world for the page's script.

    Args:
        surfaces: Meshes with `triangles` (n, 3, 3), metres in the world.
        origin: Lower corner of the sample's map (3,), metres in the world.

    Returns:
        Corners of all triangles, one after the other, in the frame of the map.
    """
    corners = (
        np.concatenate([mesh.triangles for mesh in surfaces] or [np.empty((0, 3, 3))]) - origin
    )
    return {"triangles": _gzip64(corners.astype("<f4").tobytes())}


def _packed_movers(timeline: Timeline) -> Json:
    """Encode movers for the page's script, which evaluates their courses. Times but `now` are
    seconds after it."""
    from scenegen.worlds.movers import encoded

    movers, now_s = timeline.movers, float(timeline.scan_times[0])
    entry: Json = {
        "now": now_s,
        "scans": (timeline.scan_times - now_s).tolist(),
        "end": timeline.end_s - now_s,
        # JSON has no infinity
        "period": movers.period_s if math.isfinite(movers.period_s) else None,
        "table": _gzip64(encoded(movers).encode()),
    }
    if timeline.standing is not None:
        entry["standing"] = _bits(timeline.standing)
    return entry


def _packed_guess(guess: Guess, look: Look) -> Json:
    """Encode a prediction for the page's script; positions are in the frame of the map."""

    def local(points: Floats | None) -> Any:
        return None if points is None else np.round(points - look.origin, 4).tolist()

    entry: Json = {"name": guess.name, "mask": _bits(guess.occupied)}
    if guess.tudf is not None:
        entry["tudf"] = _distances(guess.tudf, look.grid)
    if guess.chance is not None:
        entry["chance"] = _bytes(guess.chance)
    if (route := guess.route) is not None:
        ends = {"start": local(route.start), "goal": local(route.goal), "hit": local(route.hit)}
        entry["route"] = {**ends, "points": local(route.points) or [], "flown": route.flown}
    return entry


def _bits(mask: Mask) -> str:
    return _gzip64(np.packbits(mask).tobytes())


def _distances(tudf: Field, grid: GridSpec) -> str:
    return _bytes(tudf / grid.truncation_m)


def _bytes(shares: Field) -> str:
    # damaged distances may be NaN, which has no byte
    shares = np.nan_to_num(shares, nan=1.0)
    return _gzip64(np.rint(255 * np.clip(shares, 0, 1)).astype(np.uint8).tobytes())


def _text(name: str) -> str:
    return HERE.joinpath(name).read_text(encoding="utf-8")


def _gzip64(content: bytes) -> str:
    # without the time of compression: the same samples give the same page
    return base64.b64encode(gzip.compress(content, 6, mtime=0)).decode()


# ASCII, since \d also means the digits of other scripts
REQUEST = re.compile(r"/(sample|world)/(\d{1,4})/(train|val|test)/(\d{1,10})", re.ASCII)
LOCAL = "localhost"
IDLE_S = 30.0
"""Time after which an idle connection is closed, seconds."""
SAFE = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}
"""Headers of every answer, so that no other site can frame or read it."""


Reply = tuple[HTTPStatus, str, bytes]
"""Status, media type and content of an answer."""


class PageServer(ThreadingHTTPServer):
    """The server of one page, which holds what it shows."""

    # seconds after which `handle_request` returns, so that a loop around it sees a stop
    timeout = 0.5
    request_queue_size = 64

    def __init__(self, page: str, *, host: str = "127.0.0.1", port: int = 0):
        """Listen.

        Args:
            page: Content of the page.
            host: An IP address, or `localhost`.
            port: The port; 0 for any free one.

        Raises:
            ScenegenError: The address is not one of this machine, or is in use.
        """
        self.page = page.encode()
        try:
            place = ipaddress.ip_address("127.0.0.1" if host == LOCAL else host)
        except ValueError:
            raise ScenegenError(
                f"--host {host}: is no IP address; give one of this machine's, such as 127.0.0.1"
            ) from None
        self.address_family = socket.AF_INET6 if place.version == 6 else socket.AF_INET
        self.on_loopback = place.is_loopback
        """Whether only this machine can reach it."""
        try:
            super().__init__((str(place), port), _Handler)
        except OSError as error:
            raise ScenegenError(
                f"{host}, port {port}: cannot be served on ({error.strerror or error}); give "
                "another --port, or 0"
            ) from None
        url_host = f"[{place}]" if place.version == 6 else str(place)
        if place.is_unspecified:  # 0.0.0.0 is no address that a browser can open
            url_host = socket.gethostname()
        self.address = f"http://{url_host}:{self.server_address[1]}/"
        """Address for the browser."""

    def server_bind(self) -> None:
        """Bind, without the base class's look-up of this machine's name, which can take seconds."""
        socketserver.TCPServer.server_bind(self)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report an error in one line, unless the browser closed the connection.

        Args:
            request: The connection, unused.
            client_address: The client, unused.
        """
        if not isinstance(error := sys.exc_info()[1], OSError):
            print(printable(f"scenegen view: {type(error).__name__}: {error}"), file=sys.stderr)

    def allows(self, host: str) -> bool:
        """Whether the Host header of a request is an address, or this server's own name.

        The page of a stranger can make its own name lead to this server and read the answers (DNS
        rebinding). Its requests have that name as their Host.
        """
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        # the page of a stranger asks by a name, never by a bare address
        with suppress(ValueError):
            return bool(ipaddress.ip_address(name))
        # `address` has the machine's name only where other machines can reach it
        return name == LOCAL or (not self.on_loopback and name == socket.gethostname().lower())

    def reply(self, path: str) -> Reply | None:
        """Answer a request of the page for a part; None if there is none at this path. This page
        has all its parts in it.

        Args:
            path: Path of the address.
        """
        return None


class Live(PageServer):
    """The server of a page for datasets, which reads samples when they are asked for."""

    def __init__(
        self,
        datasets: Sequence[AnyDataset],
        *,
        split: str,
        index: int = 0,
        host: str = "127.0.0.1",
        port: int = 0,
        guesses: Guesses | None = None,
        methods: tuple[str, ...] = (),
    ):
        """Listen, and prepare the page.

        Args:
            datasets: The datasets.
            split: Split of the first dataset that is shown first.
            index: Index of the sample that is shown first.
            host: An IP address, or `localhost`.
            port: The port; 0 for any free one.
            guesses: Function that predicts samples when they are shown, or None.
            methods: Names of the methods that predict.

        Raises:
            DatasetError: A grid is too large for a browser.
            ScenegenError: The address is not one of this machine, or is in use.
        """
        for dataset in datasets:
            check_grid(dataset.grid)
        self.datasets, self.guesses, self._reading = datasets, guesses, threading.Lock()
        counts = [
            {
                "name": title_of(dataset),
                "splits": {
                    name: len(samples) for name in SPLITS if (samples := dataset.split(name))
                },
            }
            for dataset in datasets
        ]
        page = live_page(counts, split=split, index=index, methods=methods)
        super().__init__(page, host=host, port=port)

    def server_close(self) -> None:
        """Close, and wait for the sample that is being read: a thread inside torch can abort the
        process when Python shuts down."""
        super().server_close()
        self._reading.acquire()  # and never released: no other sample is read

    def reply(self, path: str) -> Reply | None:
        """Answer with a sample or its world as JSON, or a line in `error`, see
        `PageServer.reply`."""
        if (request := REQUEST.fullmatch(path)) is None:
            return None
        status, answer = self._answer(request[1], int(request[2]), request[3], int(request[4]))
        return status, "application/json", json.dumps(answer).encode()

    def _answer(self, kind: str, number: int, split: str, index: int) -> tuple[HTTPStatus, Json]:
        if number >= len(self.datasets):
            return HTTPStatus.NOT_FOUND, {"error": "no such dataset"}
        samples = self.datasets[number].split(split)
        notes = {"notes": incomplete(samples.dataset, split)}
        with self._reading:  # one at a time: threads share open files and networks
            try:
                if kind == "world":
                    return HTTPStatus.OK, _world(samples, index)
                return HTTPStatus.OK, packed(look_into(samples, index, self.guesses)) | notes
            # a damaged sample is a line on the page, and the server goes on
            except (ScenegenError, OSError, IndexError, ValueError) as error:
                line = f"the {kind} is not shown: {printable(error)}"
                return HTTPStatus.NOT_FOUND, {"error": line, **notes}


def _world(samples: Split, index: int) -> Json:
    """Compile the world of a sample and encode its surfaces."""
    # loads MuJoCo and trimesh, which only worlds need
    from scenegen.view.glb import surfaces
    from scenegen.worlds.world import solid

    sample = samples[index]
    world = solid(samples.dataset.compile(samples.name, int(sample.world)), "the world")
    return packed_world(surfaces(world), sample.origin)


class _Handler(BaseHTTPRequestHandler):
    """Handles one connection."""

    server: PageServer
    # nobody is told versions of software
    server_version, sys_version = "scenegen", ""
    # 1.1 keeps the connection, since a page asks for one sample after another
    protocol_version = "HTTP/1.1"
    timeout = IDLE_S
    disable_nagle_algorithm = True  # else an answer can wait 40 ms for the browser's receipt

    def do_GET(self) -> None:
        """Answer with the page, a sample or a world."""
        hosts = self.headers.get_all("Host") or []
        # exactly one, as HTTP/1.1 demands (RFC 9112, 3.2)
        if len(hosts) != 1 or not self.server.allows(hosts[0]):
            refusal = b"this name is not the viewer's; open its address\n"
            self._answer(HTTPStatus.FORBIDDEN, "text/plain", refusal)
        elif self.path == "/":
            self._answer(HTTPStatus.OK, "text/html", self.server.page)
        elif reply := self.server.reply(self.path):
            self._answer(*reply)
        else:
            self._answer(HTTPStatus.NOT_FOUND, "text/plain", b"no such page\n")

    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing for a request."""

    def _answer(self, status: HTTPStatus, kind: str, content: bytes) -> None:
        self.send_response(status)
        headers = {"Content-Type": f"{kind}; charset=utf-8", "Content-Length": str(len(content))}
        for name, value in (SAFE | headers).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)
