"""A server of S3's protocol in this process, over a folder of objects: it says what it was asked
for, and fails as often as it is told to."""

import hashlib
from functools import cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Lock, Thread
from urllib.parse import parse_qs, unquote, urlsplit


class Served(ThreadingHTTPServer):
    """The server, while the block lasts; ``home/bucket/key`` are its objects."""

    request_queue_size = 100
    daemon_threads = True

    def __init__(self, home: Path, fail_every: int = 0):
        super().__init__(("127.0.0.1", 0), Answer)
        self.home, self.fail_every = home, fail_every
        self.room: int | None = None
        """How many more objects are taken before the store is full."""
        self.log: list[tuple[str, int]] = []
        """What was asked for, "GET train-00000.h5" or "LIST", and the bytes of each answer."""
        self.alone = Lock()
        Thread(target=self.serve_forever, args=(0.01,), daemon=True).start()

    @property
    def environment(self) -> dict[str, str]:
        """What a client's environment has to say."""
        url = f"http://127.0.0.1:{self.server_port}"
        return {"AWS_ENDPOINT_URL": url, "AWS_ACCESS_KEY_ID": "x", "AWS_SECRET_ACCESS_KEY": "x"}

    def handle_error(self, *about: object) -> None:
        """Nothing: who asked was killed."""

    def server_close(self) -> None:
        """Ends the server, as the block's end does."""
        self.shutdown()
        super().server_close()


class Answer(BaseHTTPRequestHandler):
    """One request."""

    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    server: Served

    def _answer(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        url, server = urlsplit(self.path), self.server
        path, query = server.home / unquote(url.path[1:]), parse_qs(url.query)
        what = "LIST" if query else f"{self.command} {path.name}"
        with server.alone:
            server.log.append((what, 0))
            number = len(server.log)
        fails = bool(server.fail_every) and number % server.fail_every == 0
        wanted, part = self.headers.get("If-Match"), self.headers.get("Range")
        refuses = fails and number // server.fail_every % 2
        with server.alone:  # nobody puts anything between a look and a put
            content = path.read_bytes() if path.is_file() else None
            tag = tag_of(content or b"")
            other = (wanted and wanted != tag) or (self.headers.get("If-None-Match") and content)
            full = server.room == 0
            if self.command == "PUT" and not refuses and not other and not full:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(body)
                server.room = None if server.room is None else server.room - 1
        if refuses:
            self._send(503)
        elif self.command == "PUT" and full:
            self._send(507)
        elif query:
            self._send(200, listing(path, query))
        elif other:
            self._send(412)
        elif self.command == "PUT":
            self._send(200, ETag=tag_of(body))
        elif self.command == "DELETE":
            path.unlink(missing_ok=True)
            self._send(204)
        elif content is None:
            self._send(404)
        else:
            asked, first = part_of(content, part)
            span = f"bytes {first}-{first + len(asked) - 1}/{len(content)}"
            more = {"Content-Range": span} if part else {}
            self._send(206 if part else 200, asked, cut=fails, ETag=tag, **more)
            server.log[number - 1] = what, len(asked)

    do_GET = do_PUT = do_HEAD = do_DELETE = _answer  # noqa: N815

    def _send(self, status: int, content: bytes = b"", cut: bool = False, **headers: str) -> None:
        self.send_response(status)
        for name, value in {"Content-Length": str(len(content)), **headers}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content[: len(content) // 2] if cut else content)
        self.close_connection |= cut

    def log_message(self, *said: object) -> None:
        """Nothing."""


def tag_of(content: bytes) -> str:
    """The version of some content."""
    return f'"{hashlib.md5(content).hexdigest()}"'


@cache
def tag_in(path: Path, written: int) -> str:
    """The version of what a file holds since the moment in which it was `written`, nanoseconds."""
    return tag_of(path.read_bytes())


def part_of(content: bytes, asked: str | None) -> tuple[bytes, int]:
    """What a header Range asks for of some content, and where that begins."""
    first, _, last = (asked or "bytes=0-").removeprefix("bytes=").partition("-")
    begin = int(first) if first else max(len(content) - int(last), 0)
    return content[begin : int(last) + 1 if first and last else None], begin


def listing(bucket: Path, asked: dict[str, list[str]]) -> bytes:
    """The answer to a request for a list, as XML: all objects at once, in folders, too."""
    folder = bucket / asked.get("prefix", [""])[0]
    rows = [
        f"<Contents><Key>{path.relative_to(bucket)}</Key><Size>{path.stat().st_size}</Size>"
        f"<ETag>{tag_in(path, path.stat().st_mtime_ns)}</ETag></Contents>"
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    ]
    return (
        f"<ListBucketResult>{''.join(rows)}<IsTruncated>false</IsTruncated></ListBucketResult>"
    ).encode()
