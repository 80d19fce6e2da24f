"""A small run, and processes for more of them."""

import multiprocessing

import torch

import scenegen.model.training.loop
from scenegen.model.config import NetworkConfig, TrainConfig
from scenegen.model.training.data import opened

SMALL = TrainConfig(network=NetworkConfig(width=4), epochs=3, batch=4, precision="float32")


def train(folders, config, out, **more):
    """Train on datasets, as the command does."""
    return scenegen.model.training.loop.train(
        opened(folders, "train"), opened(folders, "val"), config, out, **more
    )


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
