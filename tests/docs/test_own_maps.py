"""Recorded maps of a user's own are trained on as docs/examples does."""

import numpy as np

from lidarsim import GridSpec
from scenegen.model.checkpoint import load_network
from tests.command_line import page


def test_the_documented_maps_train(tmp_path, monkeypatch, rng):
    """With a smaller grid and network."""
    monkeypatch.chdir(tmp_path)
    for name in ("train", "val"):
        occupancy = rng.random((4, 16, 16, 16)) < 0.1
        observed = occupancy & (rng.random(occupancy.shape) < 0.5)
        np.savez(f"{name}.npz", observed=observed, occupancy=occupancy)
    small = 'maps=8, width=4, precision="float32"'
    text = page("examples/recorded.py").replace("maps=5000", small)
    text = text.replace("GridSpec()", "GridSpec(shape=(16, 16, 16))")
    exec(text, {})
    network, saved_grid, about = load_network(tmp_path / "runs/yard/best.safetensors")
    assert network.config.width == 4
    assert saved_grid == GridSpec(shape=(16, 16, 16))
    assert about["settings"]["kinds"] == ["yard"]
