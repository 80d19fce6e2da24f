"""The page to look at samples with: a file that holds all that it shows, or what a server on this
machine shows of whole datasets, whose samples are read as one steps through them.

``GET /`` is the page; ``GET /sample/<dataset>/<split>/<index>`` a sample, JSON as `packed` has it,
of the dataset of that number; ``GET /world/…`` the world that it is of, where its shard's archive
holds it. There is nothing else, and nothing changes.
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
from scenegen.view.look import MASKS, Guess, Guesses, Look, incomplete, look_into, title_of

MOST_VOXELS = 1 << 22
"""The most voxels of a grid on a page: a browser turns this many into cubes in seconds."""
MOST_BYTES = 48 << 20
"""The most bytes of a page's samples; mail and telephones take no more."""
HERE = files("scenegen.view")


def page(looks: Sequence[Look], *, title: str, notes: Sequence[str] = ()) -> str:
    """The page of `looks`, none of whose names and texts is ever taken for HTML or for a script.

    Masks are bits, first voxel highest, in C order; distances are bytes, 255 for the truncation;
    points are int16 from the sensor, 32767 for the farthest, and the first `own` of them are of the
    sample's own scan; all of it gzip in base64. Raises DatasetError for grids that no browser
    takes.
    """
    samples: list[Json] = []
    notes, size = list(notes), 0
    for look in looks:
        check_grid(look.grid)
        sample = packed(look)
        size += len(json.dumps(sample))
        if size > MOST_BYTES:
            notes.append(
                f"{len(looks) - len(samples)} samples are left out: the page would be too large"
            )
            break
        samples.append(sample)
    methods = list(dict.fromkeys(guess.name for look in looks for guess in look.guesses))
    masks = list(dict.fromkeys(name for look in looks for name in look.masks))
    return _filled({"title": title, "notes": notes, "samples": samples, "masks": masks}, methods)


def live_page(datasets: Sequence[Json], *, split: str, index: int, methods: Sequence[str]) -> str:
    """The page of samples that are fetched from its own server one by one,
    ``sample/<dataset>/<split>/<index>`` as `packed` has them; datasets are numbered.

    `datasets` says of each its `name` and how many samples it has of which `splits`, `split` and
    `index` which of the first is shown first, `methods` who predicts.
    """
    live = {"datasets": datasets, "split": split, "index": index}
    title = datasets[0]["name"]
    about = {"title": title, "notes": [], "samples": [], "masks": MASKS, "live": live}
    return _filled(about, methods, "; connect-src 'self'")


def _filled(about: Json, methods: Sequence[str], policy: str = "") -> str:
    """The page with what its script reads, and what its policy allows besides."""
    colours = list(zip(methods, path_colours(methods), strict=True))
    # JSON all the same, and no tag can end the element that holds it
    data = json.dumps({"colours": ON_PAGE, "methods": colours, **about}).replace("<", "\\u003c")
    parts = {
        "TITLE": html.escape(about["title"]),
        "POLICY": policy,
        "LICENCE": html.escape(_text("three/LICENSE")).replace("--", "- -"),
        "NONCE": hashlib.sha256(data.encode()).hexdigest()[:32],
        "THREE": _gzip64((HERE / "three" / "three.module.min.js").read_bytes()),
        "ORBIT": _gzip64((HERE / "three" / "OrbitControls.js").read_bytes()),
        "SCRIPT": _text("page.js"),
        "DATA": data,
    }
    # text, a part's name, text, …: so no part is looked at for names
    pieces = _text("page.html").split("%%")
    return "".join(parts[piece] if n % 2 else piece for n, piece in enumerate(pieces))


def check_grid(grid: GridSpec) -> None:
    """Raise DatasetError for a grid that no browser takes."""
    if (voxels := math.prod(grid.shape)) > MOST_VOXELS:
        raise DatasetError(
            f"maps of {voxels} voxels; a page shows {MOST_VOXELS} at most; use scenegen render"
        )


def packed(look: Look) -> Json:
    """A sample as the page's script reads it; see `page`."""
    grid, more = look.grid, dict[str, Any]()
    if look.tudf is not None:
        more["tudf"] = _distances(look.tudf, grid)
    for name, mask in (("scored", look.scored), ("certain", look.certain)):
        if mask is not None and not mask.all():
            more[name] = _bits(mask)
    if look.points is not None:
        from_sensor = look.points - look.position
        reach = float(np.abs(from_sensor).max(initial=1e-6))
        packed = _gzip64(np.rint(from_sensor / reach * 32767).astype("<i2").tobytes())
        more |= {"points": packed, "reach": reach, "own": len(look.scans[0])}
    return {
        "name": look.name,
        "shape": list(grid.shape),
        "voxel": grid.voxel_m,
        "truncation": grid.truncation_m,
        "origin": look.origin.tolist(),
        "position": look.position.tolist(),
        "heading": look.heading_deg(),
        "figures": look.figures(),
        "missing": list(look.missing),
        "masks": {name: _bits(mask) for name, mask in look.masks.items()},
        "guesses": [_packed_guess(guess, look) for guess in look.guesses],
        **more,
    }


def packed_world(surfaces: Sequence[Any], origin: Floats) -> Json:
    """A world's surfaces, meshes with (n, 3, 3) `triangles` in metres, as the page's script reads
    them: the corners of all triangles, one after the other, in the frame of the map at `origin`
    (3,)."""
    corners = (
        np.concatenate([mesh.triangles for mesh in surfaces] or [np.empty((0, 3, 3))]) - origin
    )
    return {"triangles": _gzip64(corners.astype("<f4").tobytes())}


def _packed_guess(guess: Guess, look: Look) -> Json:
    """What is predicted, as the page's script reads it; positions in the map's frame."""

    def local(points: Floats | None) -> Any:
        return None if points is None else np.round(points - look.origin, 4).tolist()

    found: Json = {"name": guess.name, "mask": _bits(guess.occupied)}
    if guess.tudf is not None:
        found["tudf"] = _distances(guess.tudf, look.grid)
    if (route := guess.route) is not None:
        ends = {"start": local(route.start), "goal": local(route.goal), "hit": local(route.hit)}
        found["route"] = {**ends, "points": local(route.points) or []}
    return found


def _bits(mask: Mask) -> str:
    return _gzip64(np.packbits(mask).tobytes())


def _distances(tudf: Field, grid: GridSpec) -> str:
    shares = np.nan_to_num(tudf / grid.truncation_m, nan=1.0)
    return _gzip64(np.rint(255 * np.clip(shares, 0, 1)).astype(np.uint8).tobytes())


def _text(name: str) -> str:
    return HERE.joinpath(name).read_text(encoding="utf-8")


def _gzip64(content: bytes) -> str:
    return base64.b64encode(gzip.compress(content, 6, mtime=0)).decode()


ASKED = re.compile(r"/(sample|world)/(\d{1,4})/(train|val|test)/(\d{1,10})", re.ASCII)
LOCAL = "localhost"
IDLE_S = 30.0
"""How long a connection may say nothing, seconds."""
SAFE = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}
"""Headers of every answer: no other site frames or reads it."""


class Live(ThreadingHTTPServer):
    """The server of some datasets.

    `host` is an IP address or `localhost`; port 0 is any that is free. `guesses` predicts samples
    as they are shown, by the methods called `methods`. The page begins with sample `index` of a
    `split` of the first dataset. Raises ScenegenError where the address cannot be had, DatasetError
    for a grid that no browser takes.
    """

    timeout = 0.5
    request_queue_size = 64

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
        for dataset in datasets:
            check_grid(dataset.grid)
        self.datasets, self.guesses, self._reading = datasets, guesses, threading.Lock()
        counts = [
            {
                "name": title_of(dataset),
                "splits": {name: len(found) for name in SPLITS if (found := dataset.split(name))},
            }
            for dataset in datasets
        ]
        self.page = live_page(counts, split=split, index=index, methods=methods).encode()
        try:
            place = ipaddress.ip_address("127.0.0.1" if host == LOCAL else host)
        except ValueError:
            raise ScenegenError(
                f"--host {host}: is no IP address; give one of this machine's, such as 127.0.0.1"
            ) from None
        self.address_family = socket.AF_INET6 if place.version == 6 else socket.AF_INET
        self.on_loopback = place.is_loopback
        """Whether other machines cannot reach it."""
        try:
            super().__init__((str(place), port), _Handler)
        except OSError as error:
            raise ScenegenError(
                f"{host}, port {port}: cannot be served on ({error.strerror or error}); give "
                "another --port, or 0"
            ) from None
        shown = f"[{place}]" if place.version == 6 else str(place)
        if place.is_unspecified:
            shown = socket.gethostname()
        self.address = f"http://{shown}:{self.server_address[1]}/"
        """What to open in a browser."""

    def server_bind(self) -> None:
        """Bind; the base class would look this machine's name up in the network."""
        socketserver.TCPServer.server_bind(self)

    def server_close(self) -> None:
        """Close, and read no more samples: threads that were in torch have been seen to abort a
        process that Python takes down around them."""
        super().server_close()
        self._reading.acquire()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that went away is no error; any other is ours, and is told in one line."""
        if not isinstance(error := sys.exc_info()[1], OSError):
            print(printable(f"scenegen view: {type(error).__name__}: {error}"), file=sys.stderr)

    def allows(self, host: str) -> bool:
        """Whether a request may call this server `host`: by an address, or by its own name.

        A stranger's page can have its own name lead here (DNS rebinding), and then read what is
        served; the browser still says by which name it came.
        """
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        with suppress(ValueError):
            return bool(ipaddress.ip_address(name))
        return name == LOCAL or (not self.on_loopback and name == socket.gethostname().lower())

    def answer(self, what: str, number: int, split: str, index: int) -> tuple[HTTPStatus, Json]:
        """A sample of dataset `number` for the page, or the world that it is of; or, under `error`,
        a line that says why there is none."""
        if number >= len(self.datasets):
            return HTTPStatus.NOT_FOUND, {"error": "no such dataset"}
        samples = self.datasets[number].split(split)
        notes = {"notes": incomplete(samples.dataset, split)}
        with self._reading:  # one at a time: files and networks are shared
            try:
                if what == "world":
                    return HTTPStatus.OK, _world(samples, index)
                return HTTPStatus.OK, packed(look_into(samples, index, self.guesses)) | notes
            except (ScenegenError, OSError, IndexError, ValueError) as error:
                line = f"the {what} is not shown: {printable(error)}"
                return HTTPStatus.NOT_FOUND, {"error": line, **notes}


def _world(samples: Split, index: int) -> Json:
    """The surfaces of the world of a sample."""
    # MuJoCo and trimesh are needed for worlds alone
    from scenegen.view.glb import surfaces
    from scenegen.worlds.world import solid

    sample = samples[index]
    world = solid(samples.dataset.compile(samples.name, int(sample.world)), "the world")
    return packed_world(surfaces(world), sample.origin)


class _Handler(BaseHTTPRequestHandler):
    """Answers one connection."""

    server: Live
    server_version, sys_version = "scenegen", ""
    protocol_version = "HTTP/1.1"
    timeout = IDLE_S

    def do_GET(self) -> None:
        """Give the page, or a sample."""
        hosts = self.headers.get_all("Host") or []
        if len(hosts) != 1 or not self.server.allows(hosts[0]):
            told = b"this name is not the viewer's; open its address\n"
            self._answer(HTTPStatus.FORBIDDEN, "text/plain", told)
        elif self.path == "/":
            self._answer(HTTPStatus.OK, "text/html", self.server.page)
        elif found := ASKED.fullmatch(self.path):
            status, answer = self.server.answer(found[1], int(found[2]), found[3], int(found[4]))
            self._answer(status, "application/json", json.dumps(answer).encode())
        else:
            self._answer(HTTPStatus.NOT_FOUND, "text/plain", b"no such page\n")

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not told."""

    def _answer(self, status: HTTPStatus, kind: str, content: bytes) -> None:
        self.send_response(status)
        about = {"Content-Type": f"{kind}; charset=utf-8", "Content-Length": str(len(content))}
        for name, value in (SAFE | about).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)
