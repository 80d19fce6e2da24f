"""Warp, told to be quiet, and where its arrays are to lie. `wp` is imported from here, for errors that say what to do."""

import ctypes
import os
from typing import Any

import numpy as np

from lidarsim.jit import cache_folder, cache_trouble

try:
    import warp as wp
except ModuleNotFoundError:
    raise ImportError("the GPU engine needs NVIDIA Warp; in scenegen's checkout: pip install -e '.[gpu]'") from None

__all__ = ["EXACT", "on_device", "placed", "ready", "wp"]

EXACT = {"enable_backward": False, "fuse_fp": False}
"""Options of a module of kernels: no gradients, and no fused multiplications, which would round otherwise."""


def ready(device: str) -> str:
    """Warp's name of `device` ("cuda", "cuda:1", …), with Warp started. Raises ValueError where there is no such GPU.

    Kernels are kept beside numba's (`lidarsim.jit`), unless the user's own settings of Warp name another folder.
    """
    if device.startswith("cuda") and not _has_driver():  # asked first, for Warp itself complains on the terminal
        raise ValueError(f"no NVIDIA driver is found here, so there is no device {device!r}; use the analytic engine")
    if not (wp.config.kernel_cache_dir or "WARP_CACHE_PATH" in os.environ or cache_trouble("lidarsim")):
        wp.config.kernel_cache_dir = str(cache_folder("lidarsim").parent / f"warp-{wp.config.version}")
    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    try:
        return wp.get_device(device).alias
    except (ValueError, RuntimeError) as error:
        there = ", ".join(one.alias for one in wp.get_cuda_devices()) or "no GPU"
        raise ValueError(f"device {device!r}: Warp sees {there}; use one, or the analytic engine") from error


def _has_driver() -> bool:
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    return True


def on_device(values: Any, dtype: Any, device: str) -> Any:
    """`values` as an array of Warp's on `device`: Warp's own as they are, anything else by NumPy.

    A tensor of torch's is taken without a copy by ``wp.from_torch(tensor, dtype=wp.vec3d)``.
    """
    if isinstance(values, wp.array):
        return values
    scalar = np.int32 if dtype is wp.int32 else np.float64  # others are not used
    return wp.array(np.ascontiguousarray(values, dtype=scalar), dtype=dtype, device=device)


def placed(name: str, array: Any, shape: tuple[int, ...], dtype: Any, device: str) -> Any:
    """`array` where it has what a kernel expects, which does not look. Raises ValueError."""
    found = (tuple(array.shape), array.dtype, array.device.alias)
    if found != (shape, dtype, device):
        have, want = (f"{shape} of {dtype.__name__} on {where}" for shape, dtype, where in (found, (shape, dtype, device)))
        raise ValueError(f"{name}: an array {have}, expected {want}")
    return array
