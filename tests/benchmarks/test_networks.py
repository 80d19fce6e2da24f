"""What networks cost, counted by hand."""

import importlib
from pathlib import Path

from scenegen.model.config import NetworkConfig

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
SHAPE = (16, 24, 8)


def test_costs_are_what_the_layers_add_up_to(monkeypatch):
    """Multiply-accumulates of a single branch, layer by layer: kernel x channels in x channels out
    x cells out."""
    monkeypatch.syspath_prepend(BENCHMARKS)
    cost = importlib.import_module("networks").cost
    found = cost(NetworkConfig(variant="occ"), SHAPE)
    cells = [SHAPE[0] * SHAPE[1] * SHAPE[2] // 8**level for level in (1, 2, 3)]
    macs = 27 * cells[0] * (1 * 8 + 8 * 8)  # pre-processing
    for level, (below, width) in enumerate(((8, 8), (8, 16), (16, 32))):
        macs += 27 * cells[level] * (below * width + width * width)  # encoder
        macs += 27 * cells[level] * (2 * width * width + width * width)  # decoder
    macs += cells[2] * 32 * (3 * 32 + 32) + 2 * cells[2] ** 2 * 32  # attention
    macs += cells[2] * 8 * 32 * 16 + cells[1] * 8 * 16 * 8  # transposed convolutions
    macs += 27 * cells[0] * (8 * 8 + 8 * 8)  # head
    assert found["macs"] == macs
    assert found["parameters"] == 179_496
    assert cost(NetworkConfig(), SHAPE)["parameters"] == 305_496
    assert found["activation_bytes"] > 4 * 10 * 8 * cells[0]
