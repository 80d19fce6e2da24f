"""The same source gives the same numbers in Python and in Warp."""

import math

import numpy as np
import pytest

from lidarsim.jit import kernel

wp = pytest.importorskip("warp", reason="NVIDIA Warp is not installed: pip install -e '.[gpu]'")

from lidarsim.gpu.translate import translated  # noqa: E402

SMALL = 1.0 - 2e-11
"""Less than 1, but not in single precision."""


def words(x, y, z):  # type: ignore[no-untyped-def]
    """Every word that the translation changes."""
    low, high = -z, z
    total, whole = 0.1, 0
    for one, sign in ((x, -1.0), (y, 1.0)):
        if min(x, y, z) <= one < max(x, y, z):
            total += sign * one * SMALL + 1e-300
            whole += math.floor(one) - math.ceil(y)
        if total > x:
            continue
        high = total
    table = np.empty((2, 3))
    place = (x, y, high)
    for a in range(3):
        table[1, a] = place[a] if low < place[a] < math.inf else float(whole)
    return table[1, 0] + table[1, 1] * table[1, 2] + z


function = translated(kernel(words))


@wp.kernel
def each(values: wp.array2d[wp.float64], results: wp.array[wp.float64]) -> None:
    n = wp.tid()
    results[n] = function(values[n, 0], values[n, 1], values[n, 2])


def test_a_kernel_has_the_same_value_in_warp():
    wp.set_module_options({"fuse_fp": False})
    values = np.random.default_rng(0).uniform(-3, 3, (200, 3))
    results = wp.zeros(len(values), dtype=wp.float64, device="cpu")
    wp.launch(each, dim=len(values), inputs=[wp.array(values, device="cpu"), results], device="cpu")
    assert results.numpy().tolist() == [words(*row) for row in values.tolist()]
