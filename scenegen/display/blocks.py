"""Pictures of samples for the card, drawn with numpy alone: blocks seen at an angle, and a level of
distances."""

import struct
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenegen.sample import Sample

PANEL_PX = 640
"""About the width of one panel."""
GAP_PX = 12
PAPER, FLOOR, SENSOR = (255, 255, 255), (236, 238, 242), (220, 20, 60)
HEIGHT_COLOURS = ((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37))
DISTANCE_COLOURS = ((0, 0, 4), (81, 18, 124), (183, 55, 121), (252, 137, 97), (252, 253, 191))
"""A few colours of the maps viridis and magma, from low to high."""
FACES = (1.0, 0.82, 0.62)
"""Brightness of a block's top, left and right."""

Image = NDArray[np.uint8]


def draw_sample(sample: Sample, truncation_m: float) -> bytes:
    """A PNG of three panels: `observed`, `occupancy`, and `tudf` in the level just below the
    sensor, x right and y up.

    Blocks are coloured by height, seen from above, over the corner of greatest x and least y: x
    points down right, y up right, which is the third panel turned by 45°. The dot is the sensor.
    Distances go from 0 (dark) to `truncation_m`.
    """
    level = sample.tudf.shape[2] // 2 - 1
    panels = [draw_blocks(sample.observed), draw_blocks(sample.occupancy)]
    panels.append(draw_level(sample.tudf[:, :, level] / truncation_m, height=panels[0].shape[0]))
    gap = np.full((panels[0].shape[0], GAP_PX, 3), PAPER, np.uint8)
    return to_png(np.concatenate([panels[0], gap, panels[1], gap, panels[2]], axis=1))


def draw_blocks(mask: NDArray[np.bool_]) -> Image:
    """Cubes where `mask` (x, y, z) is set, above the map's floor."""
    mask = mask[:, ::-1]  # below, the second axis comes towards the eye
    nx, ny, nz = mask.shape
    half = max(
        2, 2 * (PANEL_PX // (2 * (nx + ny)))
    )  # half a block's width in pixels, even; its height is the same
    image = np.full(((nx + ny) * half // 2 + nz * half, (nx + ny) * half, 3), PAPER, np.uint8)
    floor = np.argwhere(np.ones((nx, ny, 1), bool))
    _paint(image, mask.shape, half, floor, np.full((len(floor), 3), FLOOR), only_top=True)
    places = np.argwhere(mask & _exposed(mask))
    places = places[np.argsort(places.sum(axis=1), kind="stable")]  # those nearest to the eye last
    _paint(image, mask.shape, half, places, _colours(places[:, 2] / max(nz - 1, 1), HEIGHT_COLOURS))
    row, column = _corner(mask.shape, half, np.array([[nx / 2, ny / 2, nz / 2 - 1]]))
    _dot(image, int(row[0]), int(column[0]))
    return image


def draw_level(shares: NDArray[Any], *, height: int) -> Image:
    """A level of values from 0 to 1 (x, y), as squares: x right, y up, on a panel of `height`
    pixels."""
    size = max(1, height // max(shares.shape))
    squares = np.kron(shares.T[::-1], np.ones((size, size)))
    panel = np.full((height, squares.shape[1], 3), PAPER, np.uint8)
    top = (height - squares.shape[0]) // 2
    panel[top : top + squares.shape[0]] = _colours(squares, DISTANCE_COLOURS)
    _dot(panel, height // 2, panel.shape[1] // 2)
    return panel


def _paint(
    image: Image,
    shape: tuple[int, ...],
    half: int,
    places: NDArray[Any],
    colours: NDArray[Any],
    only_top: bool = False,
) -> None:
    """Stamp a block at every voxel of `places`, in order: later ones hide earlier ones."""
    rows, columns, light = _stamp(half, only_top)
    row, column = _corner(shape, half, places)
    flat = (row[:, None] + rows) * image.shape[1] + column[:, None] + columns
    shaded = (colours[:, None, :] * light[:, None]).astype(np.uint8)
    last = np.zeros(image.shape[0] * image.shape[1], np.int64)
    np.maximum.at(last, flat.ravel(), np.arange(1, flat.size + 1))
    seen = last > 0
    image.reshape(-1, 3)[seen] = shaded.reshape(-1, 3)[last[seen] - 1]


def _stamp(half: int, only_top: bool) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Rows, columns and brightness of a block's pixels, from its upper left corner.

    A block is 2 `half` wide; its top is a rhombus `half` high, its sides go down by another `half`.
    """
    rows, columns, light = [], [], []
    for column in range(2 * half):
        reach = (
            min(column, 2 * half - 1 - column) // 2
        ) + 1  # half the rhombus's height in this column
        for row in range(half // 2 - reach, half // 2 + reach + (0 if only_top else half)):
            top = row < half // 2 + reach
            rows.append(row)
            columns.append(column)
            light.append(FACES[0] if top else FACES[1] if column < half else FACES[2])
    return np.array(rows), np.array(columns), np.array(light)


def _corner(
    shape: tuple[int, ...], half: int, places: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Row and column of the upper left corner of the blocks at `places` (n, 3)."""
    x, y, z = places.T
    row = (x + y) * half // 2 + (shape[2] - 1 - z) * half
    return row.astype(np.int64), ((x - y + shape[1] - 1) * half).astype(np.int64)


def _exposed(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Voxels of which one of the three faces towards the eye is open."""
    beyond = np.pad(mask, ((0, 1), (0, 1), (0, 1)))
    return ~(beyond[1:, :-1, :-1] & beyond[:-1, 1:, :-1] & beyond[:-1, :-1, 1:])


def _colours(shares: NDArray[Any], anchors: tuple[tuple[int, int, int], ...]) -> Image:
    """Colours of values from 0 to 1, between `anchors`: any shape to that shape by 3."""
    at = np.linspace(0, 1, len(anchors))
    channels = [
        np.interp(shares, at, [anchor[channel] for anchor in anchors]) for channel in range(3)
    ]
    return np.stack(channels, axis=-1).astype(np.uint8)


def _dot(image: Image, row: int, column: int, radius: int = 5) -> None:
    """The sensor's mark."""
    rows, columns = np.ogrid[: image.shape[0], : image.shape[1]]
    image[(rows - row) ** 2 + (columns - column) ** 2 <= radius**2] = SENSOR


def to_png(image: Image) -> bytes:
    """An RGB image (rows, columns, 3) as a PNG file."""
    height, width, _ = image.shape
    lines = np.concatenate([np.zeros((height, 1), np.uint8), image.reshape(height, -1)], axis=1)

    def chunk(kind: bytes, content: bytes) -> bytes:
        return (
            struct.pack(">I", len(content))
            + kind
            + content
            + struct.pack(">I", zlib.crc32(kind + content))
        )

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    pixels = zlib.compress(lines.tobytes(), 6)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    )
