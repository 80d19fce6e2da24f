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

__all__ = ["EXACT", "on_device", "ready", "wp"]

EXACT = {"enable_backward": False, "fuse_fp": False, "max_unroll": 1}
"""Options of a module of kernels: no gradients; no fused multiplications, which round otherwise
than the CPU; and loops left as loops, for what is unrolled takes minutes to compile."""


def ready(device: str) -> str:
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
