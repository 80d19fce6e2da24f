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
    figures = cost(NetworkConfig(variant="occ"), SHAPE)
    cells = [16 * 24 * 8 // 8**level for level in (1, 2, 3)]
    # per level: pre-processing or what is below, encoder and decoder, which sees both
    convolutions = cells[0] * (1 * 8 + 8 * 8) + cells[0] * (8 * 8 + 8 * 8)  # and the head
    for count, (below, width) in zip(cells, ((8, 8), (8, 16), (16, 32)), strict=True):
        convolutions += count * (below * width + width * width + 3 * width * width)
    attention = cells[2] * 32 * (3 * 32 + 32) + 2 * cells[2] ** 2 * 32
    transposed = cells[2] * 8 * 32 * 16 + cells[1] * 8 * 16 * 8
    assert figures["macs"] == 27 * convolutions + attention + transposed
    assert figures["parameters"] == 179_496
    assert cost(NetworkConfig(), SHAPE)["parameters"] == 305_496
    assert figures["activation_bytes"] > 4 * 10 * 8 * cells[0]
