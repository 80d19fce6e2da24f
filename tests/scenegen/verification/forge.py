"""A forger who knows the format: edits a dataset and rewrites every checksum and digest to
match."""

import hashlib
import json
import shutil
import zipfile

import h5py
import numpy as np

from scenegen.dataset import manifest
from scenegen.dataset.schema import NAME
from scenegen.dataset.shard import zip_reproducibly
from tests.conftest import dataset_in, small_recipe
from tests.scenegen.dataset import put

COUNTS = {"train": 6, "val": 3, "test": 3}
DIGESTED = ("ranges", "position", "quaternion", "origin", "world", "viewpoint")


def make(folder, kind):
    return dataset_in(folder, small_recipe(kind), counts=COUNTS, shard_samples=6).folder


def copy(folder, to):
    return shutil.copytree(folder, to)


def load(folder, file):
    with h5py.File(folder / file) as shard:
        return {name: shard[name][()] for name in shard}, dict(shard.attrs)


def sample_digest(arrays, row):
    raw = b"".join(np.packbits(arrays[name][row]).tobytes() for name in ("observed", "occupancy"))
    raw += b"".join(np.asarray(arrays[name][row]).tobytes() for name in DIGESTED)
    return hashlib.sha256(raw).digest()


def store(folder, file, arrays, attributes, *, digests=True):
    """Write a shard, its samples' digests made to match, and sign the manifest again."""
    if digests:
        raw = b"".join(sample_digest(arrays, row) for row in range(len(arrays["world"])))
        arrays["sha256"] = np.frombuffer(raw, np.uint8).reshape(-1, 32)
    with h5py.File(folder / file, "w") as shard:
        for name, values in arrays.items():
            packed = {"compression": "gzip"} if values.ndim > 2 else {}
            shard.create_dataset(name, data=values, chunks=(1, *values.shape[1:]), **packed)
        shard.attrs.update(attributes)
    sign(folder)


def edit(folder, file, change):
    """Change a shard's arrays and leave nothing else inconsistent."""
    arrays, attributes = load(folder, file)
    change(arrays)
    store(folder, file, arrays, attributes)


def read(folder):
    """What stands in the manifest, as JSON values."""
    return json.loads((folder / NAME).read_text())


def sign(folder, **changes):
    """Make the manifest's checksums and digest, and what shards say of themselves, those of the
    files."""
    document = read(folder) | changes
    total = hashlib.sha256()
    fingerprint = manifest.parse(json.dumps(document).encode(), folder).fingerprint
    for entry in document["shards"]:
        entry["worlds_sha256"] = hashlib.sha256((folder / entry["worlds"]).read_bytes()).hexdigest()
        with h5py.File(folder / entry["file"], "r+") as shard:
            said = {"worlds_sha256": entry["worlds_sha256"], "parameters": fingerprint}
            if dict(shard.attrs) | said != dict(shard.attrs):
                shard.attrs.update(said)
            total.update(shard["sha256"][()].tobytes())
        entry["sha256"] = hashlib.sha256((folder / entry["file"]).read_bytes()).hexdigest()
    edit_manifest(folder, **document | {"digest": total.hexdigest()})


def edit_manifest(folder, **changes):
    """Change the manifest alone; the folder."""
    (folder / NAME).write_text(json.dumps(read(folder) | changes))
    return folder


def edit_at(folder, path, value):
    """Put what the JSON `value` says at a dotted path of the manifest, or, if it says nothing,
    delete what is there; the folder."""
    put(folder / NAME, path, value)
    return folder


def documents(folder, file):
    """Members of an archive by name."""
    with zipfile.ZipFile(folder / file) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def rezip(path, change):
    """Change an archive's members."""
    members = documents(path.parent, path.name)
    change(members)
    path.write_bytes(zip_reproducibly(tuple(members.items())))
