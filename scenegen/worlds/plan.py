"""ROS's occupancy grids, as map_server and Nav2 write them: a picture of a floor plan, whose cells
become columns of voxels."""

import io
import math
import re
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarsim.engines.voxels import FREE, OCCUPIED, UNKNOWN, VoxelMap
from lidarsim.parameters import short_repr
from scenegen.base.errors import SceneError, reraise_as
from scenegen.base.limits import MAX_ASSET_BYTES, MAX_CELLS, MAX_PLACE_VOXELS, MAX_RECIPE_BYTES
from scenegen.base.reading import read_bounded
from scenegen.worlds.cloud import CloudMap, Survey
from scenegen.worlds.place import box_of, check_voxel

ENTRY = re.compile(r"^(\w+):(.*(?:\n\s*-\s.*)*)", re.MULTILINE)
"""A key of the YAML file, and its value: a word, or a list in either style."""
PUNCTUATION = re.compile(r"\n\s*-\s|[\[\],\"']|(?:^|\s)#.*")
"""Separators between values, and comments."""
UNKNOWN_SHADE = 205
"""The shade of unknown cells in maps that ROS saves, whatever their `free_thresh`: with Nav2's,
0.25, a loader would count them as free."""
SAVED = {0, UNKNOWN_SHADE, 254, 255}
"""The shades in such pictures, and an editor's white."""
FLAGS = {"0": False, "1": True, "false": False, "true": True}
"""Values of `negate`."""


def read_plan(path: Path, height_m: float = Survey.height_m) -> CloudMap:
    """Read the map of a .yaml file and its picture, `.pgm` or `.png`, cropped to its known cells.

    A cell is occupied, free or unknown by the file's thresholds, as in map_server's mode `trinary`.
    Each becomes a column of cubes from the floor, z = 0, to `height_m`. Below the known ones lies a
    layer of occupied cubes, the floor.

    Args:
        path: The .yaml file.
        height_m: Height of the walls, metres.

    Returns:
        The map.

    Raises:
        SceneError: If the file is not such a map, it is turned, or too large at that height.
        DatasetError: If a file cannot be read.
    """
    text = read_bounded(path, MAX_RECIPE_BYTES).decode("latin-1")
    header = {key: PUNCTUATION.sub(" ", value).strip() for key, value in ENTRY.findall(text)}
    expected = (
        ": expected a map of ROS, with image, resolution, origin [x, y, yaw], negate, "
        "occupied_thresh and free_thresh"
    )
    with reraise_as(SceneError, f"{path}: ", expected, of=(KeyError, ValueError)):
        negate = FLAGS[header["negate"].lower()]
        voxel_m, free, occupied = (
            float(header[name]) for name in ("resolution", "free_thresh", "occupied_thresh")
        )
        x, y, yaw = map(float, header["origin"].split())
        image = path.parent / header["image"]
    check_voxel(voxel_m, str(path))
    if yaw or not math.isfinite(x + y) or not 0 <= free <= occupied <= 1:
        raise SceneError(
            f"{path}: origin {x:g} {y:g} {yaw:g}, thresholds {free:g} and {occupied:g}; expected "
            "finite metres, a yaw of 0 (turn the picture), and free_thresh below occupied_thresh"
        )
    if header.get("mode", "trinary") != "trinary":
        raise SceneError(
            f"{path}: mode {short_repr(header['mode'])}, expected trinary; save it as such"
        )
    # occupancy by shade: black is occupied unless negated
    shares = np.arange(256) / 255 if negate else 1 - np.arange(256) / 255
    states = np.where(shares > occupied, OCCUPIED, np.where(shares < free, FREE, UNKNOWN))
    shades = _shades(image)
    present = set(np.unique(shades).tolist())
    # only a picture with no other shades is surely a saver's
    saved = not negate and UNKNOWN_SHADE in present and present <= SAVED
    if saved:
        states[UNKNOWN_SHADE] = UNKNOWN
    plan = states.astype(np.uint8)[shades][::-1].T  # the topmost row has the largest y
    (row, column), (end, last) = box_of(plan, lambda row: row != UNKNOWN)
    if not end:
        raise SceneError(f"{path}: an empty map; nothing in it is known")
    plan = plan[row:end, column:last]
    layers = math.ceil(height_m / voxel_m) + 1
    if plan.size * layers > MAX_PLACE_VOXELS:
        raise SceneError(
            f"{path}: {' × '.join(map(str, plan.shape))} cells in {layers} layers, expected "
            f"{MAX_PLACE_VOXELS} voxels at most; cut the picture, or give map a lower --height"
        )
    columns_up = np.repeat(plan[:, :, None], layers, axis=2)
    columns_up[plan != UNKNOWN, 0] = OCCUPIED
    corner = [x + row * voxel_m, y + column * voxel_m, -voxel_m]
    cells = f"read: {shades.size:,} cells of {voxel_m:g} m, {np.count_nonzero(plan):,} known"
    shade = f", shade {UNKNOWN_SHADE} unknown" if saved else ""
    return CloudMap(
        VoxelMap(columns_up, voxel_m, np.array(corner)),
        np.zeros(3),
        int(np.count_nonzero(plan)),
        f"{cells} (plan of ROS, free below {free:g}, occupied above {occupied:g}{shade})",
    )


def _shades(path: Path) -> NDArray[np.uint8]:
    """Read a picture's pixels (rows, columns), 0 black to 255 white. Raises SceneError."""
    from PIL import Image, UnidentifiedImageError

    expected = (
        ": expected a grey picture of 8 bits, .pgm or .png, without alpha, of "
        f"{MAX_CELLS} cells at most"
    )
    # Pillow's errors, and any that a crafted file raises
    with reraise_as(SceneError, f"{path}: ", expected, of=Exception):
        content = io.BytesIO(read_bounded(path, MAX_ASSET_BYTES))
        with (
            warnings.catch_warnings(action="error", category=Image.DecompressionBombWarning),
            # Pillow would name the address of the bytes
            reraise_as(
                lambda message: ValueError("neither a .pgm nor a .png"), of=UnidentifiedImageError
            ),
            Image.open(content, formats=("PNG", "PPM")) as picture,
        ):
            if picture.mode not in ("1", "L", "RGB") or math.prod(picture.size) > MAX_CELLS:
                raise ValueError(f"{picture.mode}, {picture.size}")
            return np.asarray(picture.convert("L"))
