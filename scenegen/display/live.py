"""The page of whole datasets, served on this machine: samples are read as one steps through them.

``GET /`` is the page; ``GET /sample/<dataset>/<split>/<index>`` a sample, JSON as
`scenegen.display.page.packed` has it, of the dataset of that number; ``GET /world/…`` the world
that it is of, where its shard's archive holds it. There is nothing else, and nothing changes.
"""

import ipaddress
import json
import re
import socket
import socketserver
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import urlsplit

from scenegen import SPLITS
from scenegen.dataset.read import AnyDataset, Split
from scenegen.display.look import Guesses, incomplete, look_into, title_of
from scenegen.display.page import check_grid, live_page, packed, packed_world
from scenegen.errors import ScenegenError, printable
from scenegen.files import Json

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
    from scenegen.display.exchange.glb import surfaces
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
