"""Warp, told to be quiet, and where its arrays are to lie. Kernels import `wp` from here."""

import os
from typing import Any

import numpy as np

from lidarsim.jit import cache_folder, cache_trouble

try:
    import warp as wp
except ModuleNotFoundError:
    raise ImportError(
        "lidarsim.gpu needs NVIDIA Warp; in scenegen's checkout: pip install -e '.[gpu]'"
    ) from None

__all__ = ["EXACT", "on_device", "placed", "ready", "wp"]

EXACT = {"enable_backward": False, "fuse_fp": False}
"""Options of a module of kernels: no gradients, and no fused multiplications, which round otherwise
than the CPU."""


def ready(device: str) -> str:
    """Warp's name of `device` ("cuda", "cuda:1", …), with Warp started. Raises ValueError where it
    is not there.

    Kernels are kept beside numba's (`lidarsim.jit`), unless the user's own settings of Warp name
    another folder.
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


def on_device(values: Any, dtype: Any, device: str) -> Any:
    """`values` as an array of Warp's on `device`: Warp's own as they are, anything else by NumPy.

    A tensor of torch's is taken without a copy by ``wp.from_torch(tensor, dtype=wp.vec3d)``. Raises
    ValueError for vectors of other than three numbers.
    """
    if isinstance(values, wp.array):
        return values
    scalar = np.int32 if dtype is wp.int32 else np.float64  # no kernel here takes others
    given = np.ascontiguousarray(values, dtype=scalar)
    if dtype is wp.vec3d and given.shape[-1:] != (3,):
        raise ValueError(f"an array {given.shape}, expected points or vectors (…, 3)")
    return wp.array(given, dtype=dtype, device=device)


def placed(name: str, array: Any, shape: tuple[int, ...], dtype: Any, device: str) -> None:
    """Raise ValueError unless `array` has the shape, the type and the device that a kernel relies
    on."""
    found = tuple(array.shape), array.dtype, array.device.alias
    have, want = (f"{s} of {t.__name__} on {d}" for s, t, d in (found, (shape, dtype, device)))
    if have != want:
        raise ValueError(f"{name}: an array {have}, expected {want}")
