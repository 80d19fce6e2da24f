"""Family ``archives``: zip files of worlds damaged anywhere, and worlds in them that are hostile;
names, sizes and headers that lie are in test_trust.py and test_hostile.py."""

import io
import zipfile

from tests.mutations.case import VALID
from tests.mutations.damage_bytes import damage
from tests.mutations.damage_scenes import hostile
from tests.mutations.dataset_commands import read_dataset
from tests.mutations.datasets import sign

COMMANDS = ("world", "world", "world", "quick", "verify", "verify", "resume")


def attempt(random, valid, here):
    """A shard's archive, made anew of the same worlds and something else; mostly signed again."""
    name = random.choice("dc")
    folder = valid.put(name, here)
    path = folder / random.choice(
        ("train-00000.worlds.zip", "train-00000.worlds.zip", "test-00000.worlds.zip")
    )
    with zipfile.ZipFile(path) as archive:
        members = [(member, archive.read(member)) for member in archive.namelist()]
    if random.random() < 0.5:
        content, done = damage(_zipped(members), random)
    else:
        document, done, _ = hostile(random)
        which = random.randrange(len(members))
        members[which] = members[which][0], document
        content = _zipped(members)
    path.write_bytes(content)
    signed = random.random() < 0.8
    if signed:
        sign(folder)
    said = f"{name}/{path.name}: {done}{', signed again' * signed}"
    return read_dataset(random, valid, here, name, said, VALID, COMMANDS)


def _zipped(members):
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w") as archive:
        for name, content in members:
            archive.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED, 9)
    return memory.getvalue()
