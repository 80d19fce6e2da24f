"""Family ``points``: scans in every format, damaged anywhere; what files promise and do not hold is
in tests/scenegen/test_clouds.py."""

import os
from pathlib import Path

import numpy as np

from scenegen.display.exchange.files import encode_points
from tests.mutations.case import Attempt, refuses, words
from tests.mutations.damage_bytes import damage
from tests.mutations.damage_weights import holds
from tests.mutations.datasets import finite_prediction

POINTS = np.random.default_rng(1).uniform(-1.5, 1.5, (20, 3))
WRITTEN = (".pcd", ".bin", ".npz")
"""Files as `scenegen scan` writes them."""


def attempt(random, valid, here):
    """A damaged scan, completed."""
    suffix = random.choice((".ply", ".npy", ".xyz", *WRITTEN))
    path, piped = here / f"scan{suffix}", random.random() < 0.05
    if piped:
        os.mkfifo(path)
        said = "a pipe"
    else:
        written = suffix in WRITTEN
        content = (
            encode_points(suffix, POINTS) if written else (valid.folder / path.name).read_bytes()
        )
        content, said = damage(content, random)
        path.write_bytes(content)
    valid.put("n.safetensors", here)
    return Attempt(
        words=(
            *("complete", path.name),
            *words("--weights n.safetensors --quiet --device cpu -o out.h5"),
        ),
        damage=f"{path.name}: {said}",
        makes=("out.h5",),
        after=lambda: finite_prediction(Path("out.h5")),
        holds=refuses(said) if piped else holds,
    )
