"""What tests of datasets share."""

import functools
import json
import operator

from scenegen.base.reading import sha256_of
from scenegen.draw.sample import GROUPS
from tests.command_line import beside

OF_POSES = ("occupancy", "tudf", "position", "quaternion", "origin", "world", "viewpoint")
FIELDS_OF_ANY = [name for name in GROUPS[""] if name not in ("world", "viewpoint")]


def of_poses(split):
    """What a second scan from the same poses does not change."""
    return [[getattr(sample, name).tobytes() for name in OF_POSES] for sample in split]


SCENE = beside(__file__, "scene.xml")
"""A world, as the text of a file."""
NASTY = beside(__file__, "nasty.txt").splitlines()
"""JSON that stands in no file of ours at that place."""


def samples_of(dataset, split):
    """A split's samples, each by a digest of all its fields but the number of its world."""
    return [
        sha256_of(b"".join(getattr(sample, name).tobytes() for name in FIELDS_OF_ANY))
        + str(sample.viewpoint)
        for sample in dataset.split(split)
    ]


def put(file, path, value):
    """Put what the JSON `value` says at a dotted path of a JSON file; nothing deletes what is
    there."""
    document = json.loads(file.read_text())
    *above, last = (int(step) if step.isdigit() else step for step in path.split("."))
    place = functools.reduce(operator.getitem, above, document)
    if value:
        place[last] = json.loads(value)
    else:
        del place[last]
    file.write_text(json.dumps(document))
