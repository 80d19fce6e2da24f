"""A stand-in for a store, of which every process sees the same: objects in a folder, one operation
at a time."""

import fcntl
import hashlib
import os
from contextlib import contextmanager
from pathlib import Path

from scenegen.errors import DatasetError, StoreError
from scenegen.stores import ANY, WHOLE, ConflictError, Object, Store

HOME = "TESTS_KEPT"
"""Where the environment says that objects are kept."""
ROOM = "TESTS_KEPT_PUTS"
"""A file, if the environment names one, that says how many puts are taken before the store is
full."""


class Kept(Store):
    """``s3://bucket/prefix`` in a folder of that name."""

    log: list[str]
    """What this process asked for."""

    def __init__(self, name):
        self.name = name
        self.home = Path(os.environ[HOME], name.partition("://")[2])
        self.log = []

    @contextmanager
    def _alone(self, what):
        self.log.append(what)
        with (Path(os.environ[HOME]) / ".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield

    def list(self):
        with self._alone("list"):
            found = [
                Object(str(path.relative_to(self.home)), path.stat().st_size, self._version(path))
                for path in self.home.rglob("*")
                if path.is_file()
            ]
        return iter(found)

    def read(self, name, file, most_bytes, part=WHOLE):
        with self._alone(f"read {name}"):
            path = self.home / name
            if not path.is_file():
                raise FileNotFoundError(name)
            if path.stat().st_size > most_bytes:
                raise DatasetError(f"{name}: too large")
            content = path.read_bytes()
            file.write(content[slice(*part)])
            return Object(name, len(content), self._version(path))

    def put(self, name, content, version=ANY):
        path = self.home / name
        with self._alone(f"put {name}"):
            if version not in (ANY, self._version(path)):
                raise ConflictError(f"{self.name}/{name}: somebody else has put it")
            if room := os.environ.get(ROOM):
                left = int(Path(room).read_text())
                if left == 0:
                    raise StoreError(f"{self.name}/{name}: the store is full")
                Path(room).write_text(str(left - 1))
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
            return self._version(path)

    def remove(self, name):
        with self._alone(f"remove {name}"):
            (self.home / name).unlink(missing_ok=True)

    @staticmethod
    def _version(path):
        return hashlib.md5(path.read_bytes()).hexdigest() if path.is_file() else None
