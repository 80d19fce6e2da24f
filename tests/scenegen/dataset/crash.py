"""Kill a run between any two of its file operations, give the same command again, and look at what
came out.

Run as a script, in a process of its own without threads, since every run is forked: `python
crash.py FOLDER`. Prints one JSON object: the digest of an undisturbed run, and for every place of
the kill the digest after going on.
"""

import builtins
import json
import os
import signal
import sys
from pathlib import Path

from scenegen import files
from scenegen.dataset import manifest, shard
from scenegen.dataset.build import build
from tests.conftest import picky_recipe, plan_of, remembered

COUNTS = {"train": 6, "val": 0, "test": 3}
SEED = 19
"""One at which every shard rejects at least one world and one viewpoint, and few more."""


def plan_at(folder):
    recipe = picky_recipe()
    return plan_of(folder, recipe, seed=SEED, counts=COUNTS, shard_samples=6)


class Killer:
    """Counts file operations, and kills the process before the one numbered `at`; every write is
    two operations."""

    def __init__(self, at):
        self.at = at
        self.count = 0

    def tick(self):
        self.count += 1
        if self.count == self.at:
            os.kill(os.getpid(), signal.SIGKILL)

    def before(self, function):
        def ticking(*args, **kwargs):
            self.tick()
            return function(*args, **kwargs)

        return ticking

    def open(self, path, mode="r"):
        self.tick()
        file = builtins.open(path, mode)  # noqa: SIM115 (handed on open)
        return HalvingFile(file, self) if "w" in mode else file


class HalvingFile:
    """A file whose writes reach the disk half by half."""

    def __init__(self, file, killer):
        self._file, self._killer = file, killer

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self._file.close()

    def write(self, content):
        for half in (content[: len(content) // 2], content[len(content) // 2 :]):
            self._killer.tick()
            self._file.write(half)
            self._file.flush()

    def flush(self):
        self._file.flush()

    def fileno(self):
        return int(self._file.fileno())


def run_killed(folder, at):
    """Build in a forked process, killed before its operation `at`. None if killed, else the
    count."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        killer = Killer(at)
        for name in ("fsync", "open"):
            setattr(os, name, killer.before(getattr(os, name)))
        Path.replace = killer.before(Path.replace)  # type: ignore[method-assign]
        files.open = killer.open  # type: ignore[attr-defined]
        build(plan_at(folder))
        os.write(write, str(killer.count).encode())
        os._exit(0)
    os.close(write)
    _, status = os.waitpid(child, 0)
    with os.fdopen(read) as pipe:
        said = pipe.read()
    if os.WIFSIGNALED(status):
        return None
    assert os.waitstatus_to_exitcode(status) == 0
    return int(said)


def main(root):
    shard.draw_unit = remembered
    whole = build(plan_at(root / "whole"))
    rejected = [report.rejected for report in map(read, plan_at(root / "whole").shards)]
    result = {
        "digest": whole.digest,
        "manifest": manifest.read(root / "whole"),
        "every_shard_rejects": all(
            sum(r.worlds.values()) and sum(r.viewpoints.values()) for r in rejected
        ),
        "kills": [],
    }
    at = 1
    while True:
        folder = root / f"killed-{at}"
        if run_killed(folder, at) is not None:
            break
        halfway = sorted(path.name for path in folder.glob("[!.]*")) if folder.exists() else []
        whole_files = all(
            not (folder / name).name.endswith(".h5") or readable(folder / name) for name in halfway
        )
        resumed = build(plan_at(folder))
        left = sorted(path.name for path in folder.iterdir() if path.name.startswith("."))
        result["kills"].append(
            {"at": at, "digest": resumed.digest,
             "same_manifest": manifest.read(folder) == result["manifest"],
             "whole_files": whole_files, "left": left, "written": resumed.samples_written}
        )  # fmt: skip
        at += 1
    print(json.dumps(result))


def read(spec):
    return shard.read_report(spec)


def readable(path):
    import h5py

    with h5py.File(path) as file:
        return len(file["world"]) > 0


if __name__ == "__main__":
    main(Path(sys.argv[1]))
