"""Warp, and the solids of many worlds, packed into flat arrays on one device."""

import os
from collections.abc import Iterable
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarsim.engines.forms import squared_reaches
from lidarsim.engines.hierarchy import WIDTH, Hierarchy
from lidarsim.jit import cache_folder, cache_trouble, kernel
from lidarsim.solids.shapes import PLANE, Solids

try:
    import warp as wp
except ModuleNotFoundError:
    raise ImportError(
        "lidarsim.gpu needs NVIDIA Warp; in scenegen's checkout: pip install -e '.[gpu]'"
    ) from None

__all__ = ["EXACT", "Packed", "Worlds", "on_device", "wp"]

EXACT = {"enable_backward": False, "fuse_fp": False, "max_unroll": 1}
"""Options of a module of kernels: no gradients; no fused multiplications, which round otherwise
than the CPU; and loops left as loops, for what is unrolled takes minutes to compile."""


def on_device(name: str, values: Any, dtype: Any, shape: tuple[int, ...], device: str) -> Any:
    """`values` as an array of Warp's on `device`: Warp's own as they are, anything else by NumPy.

    A tensor of torch's is taken without a copy by ``wp.from_torch(tensor, dtype=wp.vec3d)``. Raises
    ValueError unless the array has the shape, the type and the device that a kernel relies on.
    """
    if not isinstance(values, wp.array):
        values = np.ascontiguousarray(values, np.float64 if dtype is wp.vec3d else None)
        if dtype is wp.vec3d and values.shape != (*shape, 3):
            raise ValueError(f"{name}: an array {values.shape}, expected {(*shape, 3)}")
        values = wp.array(values, dtype=dtype, device=device)
    found = tuple(values.shape), values.dtype, values.device.alias
    have, want = (f"{s} of {t.__name__} on {d}" for s, t, d in (found, (shape, dtype, device)))
    if have != want:
        raise ValueError(f"{name}: an array {have}, expected {want}")
    return values


Integers: TypeAlias = wp.array[wp.int32]
Vectors: TypeAlias = wp.array[wp.vec3d]


@wp.struct
class Packed:
    """What kernels read. World w owns primitives primitive_start[w] to primitive_start[w + 1];
    meshes and boxes alike.

    A ray walks its world's boxes in order: from one that it meets to the next, from one that it
    misses to `beyond`.
    """

    primitive_start: Integers
    shape: Integers
    size: wp.array2d[wp.float64]
    position: wp.array2d[wp.float64]
    rotation: wp.array3d[wp.float64]
    lower: Vectors
    upper: Vectors
    reach2: wp.array[wp.float64]  # squared radius of a ball around the primitive
    mesh_start: Integers
    filled: Integers
    triangle_start: Integers  # by mesh
    triangles: wp.array3d[wp.float64]
    box_start: Integers
    box_lower: Vectors
    box_upper: Vectors
    beyond: Integers
    first: Integers  # the box holds items first to last, or boxes
    last: Integers
    item: Integers  # the number of a primitive, or -1 - that of a triangle


class Worlds:
    """W worlds on a device, as different as they like: each has its own hierarchy of boxes for
    rays."""

    def __init__(self, solids: Iterable[Solids], *, device: str = "cuda"):
        """Pack `solids`, one table a world (`lidarsim.solids.model.solids_of`). Raises ValueError
        without a GPU."""
        self.device = _ready(device)
        arrays = _pack([_tables(one) for one in solids])
        self.count = len(arrays["box_start"]) - 1
        self.packed = Packed()
        for name, variable in Packed.vars.items():  # type: ignore[attr-defined]
            array = wp.array(arrays[name], dtype=variable.type.dtype, device=self.device)
            setattr(self.packed, name, array)

    def which(self, worlds: ArrayLike | None, poses: int) -> Any:
        """The world of each of `poses`, (P,) on the device: p for pose p unless `worlds` (P,) are
        given.

        Raises ValueError for numbers that are no world's.
        """
        chosen = np.arange(poses) if worlds is None else np.asarray(worlds)
        expected = f"expected {poses} integers from 0 to {self.count - 1}, one a pose"
        if chosen.shape != (poses,) or not np.issubdtype(chosen.dtype, np.integer):
            raise ValueError(f"which: {chosen.dtype} of shape {chosen.shape}, {expected}")
        if poses and not 0 <= chosen.min() <= chosen.max() < self.count:
            raise ValueError(f"which: {chosen.min()} to {chosen.max()}, {expected}")
        return wp.array(chosen, dtype=wp.int32, device=self.device)


def _ready(device: str) -> str:
    """Warp's name of `device` ("cuda", "cuda:1", …), with Warp started.

    Kernels are kept beside numba's (`lidarsim.jit`), unless the user's own settings of Warp name
    another folder. Raises ValueError where the device is not there.
    """
    if not (
        wp.config.kernel_cache_dir or "WARP_CACHE_PATH" in os.environ or cache_trouble("lidarsim")
    ):
        wp.config.kernel_cache_dir = str(cache_folder("lidarsim").parent / "warp")
    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    try:
        return wp.get_device(device).alias
    except (ValueError, RuntimeError):
        there = ", ".join(one.alias for one in wp.get_cuda_devices()) or "no GPU"
        raise ValueError(
            f"device {device!r}: Warp finds {there} on this machine; use the analytic engine"
        ) from None


def _pack(worlds: list[dict[str, NDArray]]) -> dict[str, NDArray]:
    """The tables of all worlds end to end, in numbers that count through."""
    if not worlds:
        raise ValueError("no worlds, expected one or more")
    counted = {"primitive": "shape", "mesh": "filled", "triangle": "triangles", "box": "beyond"}
    counted["item"] = "item"
    start = {
        what: np.cumsum([0, *(len(world[name]) for world in worlds)])
        for what, name in counted.items()
    }
    numbers = {"beyond": "box", "first": "item", "last": "item", "triangle_start": "triangle"}
    for w, world in enumerate(worlds):
        for name, what in numbers.items():
            world[name] = world[name] + start[what][w]
        shift = np.where(world["item"] >= 0, start["primitive"][w], -start["triangle"][w])
        world["item"] = world["item"] + shift
    packed = {name: np.concatenate([world[name] for world in worlds]) for name in worlds[0]}
    packed["triangle_start"] = np.append(packed["triangle_start"], start["triangle"][-1])
    return packed | {f"{what}_start": start[what] for what in ("primitive", "mesh", "box")}


def _tables(solids: Solids) -> dict[str, NDArray]:
    """One world's arrays, in its own numbers."""
    # nothing bounds planes: a first box of their own, which no ray misses
    planes, inside = np.flatnonzero(solids.shape == PLANE), np.flatnonzero(solids.shape != PLANE)
    corners = solids.triangles
    tree = Hierarchy.over(
        np.concatenate([solids.lower[inside], corners.min(axis=1)]),
        np.concatenate([solids.upper[inside], corners.max(axis=1)]),
    )
    boxes, beyond, first, last = _walk(tree.boxes, tree.links, tree.ends, len(planes))
    bounded = np.concatenate([inside, -1 - np.arange(len(corners))])
    same = ("shape", "size", "position", "rotation", "lower", "upper", "triangles")
    return {name: getattr(solids, name) for name in same} | {
        "reach2": squared_reaches(solids.shape, solids.size),
        "filled": solids.mesh_filled,
        "triangle_start": solids.mesh_start[:-1],
        "box_lower": boxes[:, :3],
        "box_upper": boxes[:, 3:],
        "beyond": beyond,
        "first": first,
        "last": last,
        "item": np.concatenate([planes, bounded[tree.order.astype(np.int64)]]),
    }


@kernel
def _walk(boxes, links, ends, planes):
    """The tree's boxes (k, 6) in the order of a walk that goes down first, behind one around the
    planes; where it goes on past each (k,), and the items in each, from (k,) to (k,)."""
    held = np.zeros(len(boxes) + 1, np.int64)  # boxes below a node
    for node in range(len(boxes) - 1, -1, -1):  # children have greater numbers
        for k in range(WIDTH):
            if ends[node, k] > 0 or links[node, k] > 0:
                held[node] += 1 if ends[node, k] > 0 else 1 + held[links[node, k]]
    count = 1 + held[0]
    walk, beyond = np.empty((count, 6)), np.ones(count, np.int64)
    first, last = np.zeros(count, np.int64), np.zeros(count, np.int64)
    walk[0, :3], walk[0, 3:] = -np.inf, np.inf
    last[0] = planes
    place = np.ones(len(boxes) + 1, np.int64)
    for node in range(len(boxes)):
        at = place[node]
        for k in range(WIDTH):
            if ends[node, k] > 0:
                first[at], last[at], after = planes + links[node, k], planes + ends[node, k], at + 1
            elif links[node, k] > 0:
                place[links[node, k]], after = at + 1, at + 1 + held[links[node, k]]
            else:
                continue
            for side in range(6):  # to assign a slice takes numba seconds to compile
                walk[at, side] = boxes[node, side, k]
            beyond[at] = after
            at = after
    return walk, beyond, first, last
