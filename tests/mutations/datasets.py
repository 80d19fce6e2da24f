"""What a dataset holds, read in ways of our own, to hold results against."""

import hashlib
import json
import sys

import h5py
import numpy as np

from scenegen import SPLITS
from scenegen.base.errors import ScenegenError
from tests.mutations.case import words

COVERED = words("observed occupancy ranges position quaternion origin world viewpoint")
"""Fields that a sample's digest covers."""
DERIVED = ("free", "tudf")


def digest_of(folder, *, derived=True):
    """A digest of what `scenegen.load` gives for every split, `derived` fields too."""
    import scenegen

    digest = hashlib.sha256()
    for split in SPLITS:
        for sample in scenegen.load(folder, split=split):
            for name in COVERED + DERIVED * derived:
                values = np.asarray(getattr(sample, name))
                # the bytes of bools, since 2 is not one
                if values.dtype == np.bool_ and values.view(np.uint8).max(initial=0) > 1:
                    raise AssertionError(f"{name} holds bools other than 0 and 1")
                head = f"{name} {values.dtype.str} {values.shape}"
                digest.update(head.encode() + values.tobytes())
    return digest.hexdigest()


def print_load(folder):
    """Print that digest; the exit code of a command that did this."""
    try:
        print(digest_of(folder))
    except ScenegenError as error:
        print(f"scenegen: {error}", file=sys.stderr)
        return 1
    return 0


def files_of(folder):
    """SHA-256 of every file that a dataset consists of; JSON counts by what it says, since
    `generate` leaves a manifest alone that says the same in other bytes."""
    found = {}
    for path in sorted(folder.iterdir()):
        if path.suffix in (".h5", ".zip", ".json"):
            content = path.read_bytes()
            if path.suffix == ".json":
                content = json.dumps(json.loads(content)).encode()
            found[path.name] = hashlib.sha256(content).hexdigest()
    return found


def sign(folder):
    """Put the files' digests as they are now into the manifest, as a forger would."""
    path = folder / "dataset.json"
    manifest = json.loads(path.read_text())
    for shard in manifest["shards"]:
        shard["worlds_sha256"] = hashlib.sha256((folder / shard["worlds"]).read_bytes()).hexdigest()
        try:
            with h5py.File(folder / shard["file"], "r+") as file:
                if file.attrs["worlds_sha256"] != shard["worlds_sha256"]:
                    file.attrs["worlds_sha256"] = shard["worlds_sha256"]
        except Exception:
            pass  # too damaged to be signed
        shard["sha256"] = hashlib.sha256((folder / shard["file"]).read_bytes()).hexdigest()
    path.write_text(json.dumps(manifest, indent=1) + "\n")
