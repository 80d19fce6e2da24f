"""The page to look at samples with: a file that holds all that it shows, or what shows a server's
samples."""

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

from lidarsim.grid import Field, Floats, GridSpec, Mask
from scenegen.display.colours import ON_PAGE, path_colours
from scenegen.display.look import MASKS, Guess, Look
from scenegen.errors import DatasetError
from scenegen.files import Json

MOST_VOXELS = 1 << 22
"""The most voxels of a grid on a page: a browser turns this many into cubes in seconds."""
MOST_BYTES = 48 << 20
"""The most bytes of a page's samples; mail and telephones take no more."""
HERE = files("scenegen.display")


def page(looks: Sequence[Look], *, title: str, notes: Sequence[str] = ()) -> str:
    """The page of `looks`, none of whose names and texts is ever taken for HTML or for a script.

    Masks are bits, first voxel highest, in C order; distances are bytes, 255 for the truncation;
    points are int16 from the sensor, 32767 for the farthest, and the first `own` of them are of the
    sample's own scan; all of it gzip in base64. Raises DatasetError for grids that no browser
    takes.
    """
    samples: list[Json] = []
    notes, size = list(notes), 0
    for look in looks:
        check_grid(look.grid)
        sample = packed(look)
        size += len(json.dumps(sample))
        if size > MOST_BYTES:
            notes.append(
                f"{len(looks) - len(samples)} samples are left out: the page would be too large"
            )
            break
        samples.append(sample)
    methods = list(dict.fromkeys(guess.name for look in looks for guess in look.guesses))
    masks = list(dict.fromkeys(name for look in looks for name in look.masks))
    return _filled({"title": title, "notes": notes, "samples": samples, "masks": masks}, methods)


def live_page(datasets: Sequence[Json], *, split: str, index: int, methods: Sequence[str]) -> str:
    """The page of samples that are fetched from its own server one by one,
    ``sample/<dataset>/<split>/<index>`` as `packed` has them; datasets are numbered.

    `datasets` says of each its `name` and how many samples it has of which `splits`, `split` and
    `index` which of the first is shown first, `methods` who predicts.
    """
    live = {"datasets": datasets, "split": split, "index": index}
    title = datasets[0]["name"]
    about = {"title": title, "notes": [], "samples": [], "masks": MASKS, "live": live}
    return _filled(about, methods, "; connect-src 'self'")


def _filled(about: Json, methods: Sequence[str], policy: str = "") -> str:
    """The page with what its script reads, and what its policy allows besides."""
    colours = list(zip(methods, path_colours(methods), strict=True))
    # JSON all the same, and no tag can end the element that holds it
    data = json.dumps({"colours": ON_PAGE, "methods": colours, **about}).replace("<", "\\u003c")
    parts = {
        "TITLE": html.escape(about["title"]),
        "POLICY": policy,
        "LICENCE": html.escape(_text("three/LICENSE")).replace("--", "- -"),
        "NONCE": hashlib.sha256(data.encode()).hexdigest()[:32],
        "THREE": _gzip64((HERE / "three" / "three.module.min.js").read_bytes()),
        "ORBIT": _gzip64((HERE / "three" / "OrbitControls.js").read_bytes()),
        "SCRIPT": _text("page.js"),
        "DATA": data,
    }
    # text, a part's name, text, …: so no part is looked at for names
    pieces = _text("page.html").split("%%")
    return "".join(parts[piece] if n % 2 else piece for n, piece in enumerate(pieces))


def check_grid(grid: GridSpec) -> None:
    """Raise DatasetError for a grid that no browser takes."""
    if (voxels := math.prod(grid.shape)) > MOST_VOXELS:
        raise DatasetError(
            f"maps of {voxels} voxels; a page shows {MOST_VOXELS} at most; use scenegen render"
        )


def packed(look: Look) -> Json:
    """A sample as the page's script reads it; see `page`."""
    grid, more = look.grid, dict[str, Any]()
    if look.tudf is not None:
        more["tudf"] = _distances(look.tudf, grid)
    for name, mask in (("scored", look.scored), ("certain", look.certain)):
        if mask is not None and not mask.all():
            more[name] = _bits(mask)
    if look.points is not None:
        from_sensor = look.points - look.position
        reach = float(np.abs(from_sensor).max(initial=1e-6))
        packed = _gzip64(np.rint(from_sensor / reach * 32767).astype("<i2").tobytes())
        more |= {"points": packed, "reach": reach, "own": len(look.scans[0])}
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
        "masks": {name: _bits(mask) for name, mask in look.masks.items()},
        "guesses": [_packed_guess(guess, look) for guess in look.guesses],
        **more,
    }


def packed_world(surfaces: Sequence[Any], origin: Floats) -> Json:
    """A world's surfaces, meshes with (n, 3, 3) `triangles` in metres, as the page's script reads
    them: the corners of all triangles, one after the other, in the frame of the map at `origin`
    (3,)."""
    corners = (
        np.concatenate([mesh.triangles for mesh in surfaces] or [np.empty((0, 3, 3))]) - origin
    )
    return {"triangles": _gzip64(corners.astype("<f4").tobytes())}


def _packed_guess(guess: Guess, look: Look) -> Json:
    """What is predicted, as the page's script reads it; positions in the map's frame."""

    def local(points: Floats | None) -> Any:
        return None if points is None else np.round(points - look.origin, 4).tolist()

    found: Json = {"name": guess.name, "mask": _bits(guess.occupied)}
    if guess.tudf is not None:
        found["tudf"] = _distances(guess.tudf, look.grid)
    if (route := guess.route) is not None:
        ends = {"start": local(route.start), "goal": local(route.goal), "hit": local(route.hit)}
        found["route"] = {**ends, "points": local(route.points) or []}
    return found


def _bits(mask: Mask) -> str:
    return _gzip64(np.packbits(mask).tobytes())


def _distances(tudf: Field, grid: GridSpec) -> str:
    shares = np.nan_to_num(tudf / grid.truncation_m, nan=1.0)
    return _gzip64(np.rint(255 * np.clip(shares, 0, 1)).astype(np.uint8).tobytes())


def _text(name: str) -> str:
    return HERE.joinpath(name).read_text(encoding="utf-8")


def _gzip64(content: bytes) -> str:
    return base64.b64encode(gzip.compress(content, 6, mtime=0)).decode()
