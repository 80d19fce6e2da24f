"""A small run, what it leaves, and processes for more of them."""

import csv
import multiprocessing
from dataclasses import dataclass, replace

import torch

import scenegen.model.training.loop
from lidarsim import GridSpec
from scenegen.model.checkpoint import load_tensors
from scenegen.model.config import NetworkConfig, TrainConfig
from scenegen.model.training.data import Maps, opened

SMALL = TrainConfig(network=NetworkConfig(width=4), epochs=3, batch=4, precision="float32")


def small(**settings):
    """The small run with other settings."""
    return replace(SMALL, **settings)


def train(folders, config, out, device="cpu", **more):
    """Train on datasets, as the command does."""
    return scenegen.model.training.loop.train(
        opened(folders, "train"), opened(folders, "val"), config, out, device=device, **more
    )


@dataclass
class Counted:
    """So many maps of a grid, seen in passes."""

    count: int
    grid: GridSpec = GridSpec()  # noqa: RUF009
    shares: None = None
    mirrored: bool = True

    def __len__(self):
        return self.count

    def order(self, batch):
        """None: these are seen in passes."""


def maps_of(folders, *inputs):
    """The maps to train on of datasets."""
    return Maps(opened(folders, "train"), "train", *inputs)


def figures(out):
    """The rows of a run's metrics.csv, less how long they took."""
    with open(out / "metrics.csv") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        del row["seconds"]
    return rows


def check_same(one, other):
    """Two runs leave the same weights and, but for times, the same figures."""
    for name in ("best.safetensors", "last.safetensors"):
        (first, _), (second, _) = load_tensors(one / name), load_tensors(other / name)
        torch.testing.assert_close(first, second, rtol=0, atol=0)
    assert figures(one) == figures(other)


def elsewhere(function, *given):
    """A process that has torch already, and runs `function`.

    Without a GPU it is a copy of this one. Autograd has threads where there is a GPU, and they are
    not copied.
    """
    context = multiprocessing.get_context("forkserver" if torch.cuda.is_available() else "fork")
    if torch.cuda.is_available():
        context.set_forkserver_preload(["scenegen.model.training.loop"])
    process = context.Process(target=function, args=given)
    process.start()
    return process
