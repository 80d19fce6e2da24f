"""One HTML file to look at samples with: it holds everything that it shows, and asks the network for nothing."""

import base64
import gzip
import hashlib
import html
import json
import math
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

import numpy as np

from lidarsim import GridSpec
from scenegen.errors import DatasetError
from scenegen.view.colours import DISTANCES, HEIGHTS, INVENTED, MISSED, SENSOR
from scenegen.view.look import Look

MOST_VOXELS = 1 << 22
"""The most voxels of a grid on a page: a browser turns this many into cubes in seconds."""
MOST_BYTES = 48 << 20
"""The most bytes of a page's samples; mail and telephones take no more."""
HERE = files("scenegen.view")


def page(looks: Sequence[Look], *, title: str, notes: Sequence[str] = ()) -> str:
    """The page of `looks`, none of whose names and texts is ever taken for HTML or for a script.

    Masks are bits, first voxel highest, in C order; distances are bytes, 255 for the truncation; points are int16 from
    the sensor, 32767 for the farthest, and the first `own` of them are of the sample's own scan; all of it gzip in
    base64. Raises DatasetError for grids that no browser takes.
    """
    samples: list[dict[str, Any]] = []
    notes, size = list(notes), 0
    for look in looks:
        check_grid(look.grid)
        sample = _packed(look)
        size += len(json.dumps(sample))
        if size > MOST_BYTES:
            notes.append(f"{len(looks) - len(samples)} samples are left out: the page would be too large")
            break
        samples.append(sample)
    colours = {"heights": HEIGHTS, "distances": DISTANCES, "sensor": SENSOR, "missed": MISSED, "invented": INVENTED}
    data = json.dumps({"title": title, "notes": notes, "colours": colours, "samples": samples})
    data = data.replace("<", "\\u003c")  # JSON all the same, and no tag can end the element that holds it
    parts = {
        "TITLE": html.escape(title),
        "LICENCE": html.escape(_text("three/LICENSE")).replace("--", "- -"),
        "NONCE": hashlib.sha256(data.encode()).hexdigest()[:32],
        "THREE": _gzip64((HERE / "three" / "three.module.min.js").read_bytes()),
        "ORBIT": _gzip64((HERE / "three" / "OrbitControls.js").read_bytes()),
        "SCRIPT": _text("page.js"),
        "DATA": data,
    }
    pieces = _text("page.html").split("%%")  # text, a part's name, text, … so that no part is looked at for names
    return "".join(parts[piece] if n % 2 else piece for n, piece in enumerate(pieces))


def check_grid(grid: GridSpec) -> None:
    """Raise DatasetError for a grid that no browser takes."""
    if (voxels := math.prod(grid.shape)) > MOST_VOXELS:
        raise DatasetError(f"maps of {voxels} voxels; a page shows {MOST_VOXELS} at most; use scenegen render")


def _packed(look: Look) -> dict[str, Any]:
    """A sample as the page's script reads it."""
    grid, packed = look.grid, dict[str, Any]()
    if look.tudf is not None:
        shares = np.nan_to_num(look.tudf / grid.truncation_m, nan=1.0)
        packed["tudf"] = _gzip64(np.rint(255 * np.clip(shares, 0, 1)).astype(np.uint8).tobytes())
    if look.points is not None:
        from_sensor = look.points - look.position
        reach = float(np.abs(from_sensor).max(initial=1e-6))
        packed |= {"points": _gzip64(np.rint(from_sensor / reach * 32767).astype("<i2").tobytes()), "reach": reach}
        packed["own"] = look.own
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
        "masks": {name: _gzip64(np.packbits(mask).tobytes()) for name, mask in look.masks.items()},
        **packed,
    }


def _text(name: str) -> str:
    return HERE.joinpath(name).read_text(encoding="utf-8")


def _gzip64(content: bytes) -> str:
    return base64.b64encode(gzip.compress(content, 6, mtime=0)).decode()
