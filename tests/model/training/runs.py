"""A small run, and processes for more of them."""

import multiprocessing
from collections.abc import Callable
from pathlib import Path
from typing import Any

import scenegen.model.training.loop
from scenegen.model.config import NetworkConfig, TrainConfig
from scenegen.model.training.data import opened

SMALL = TrainConfig(network=NetworkConfig(width=4), epochs=3, batch=4, precision="float32")


def train(folders: list[Path], config: TrainConfig, out: Path, **more: Any) -> list[dict[str, float]]:
    """Train on datasets, as the command does."""
    return scenegen.model.training.loop.train(opened(folders, "train"), opened(folders, "val"), config, out, **more)


def elsewhere(function: Callable[..., None], *given: Any) -> multiprocessing.Process:
    """A process that has torch already, and runs `function`."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["scenegen.model.training.loop"])
    process = context.Process(target=function, args=given)
    process.start()
    return process
