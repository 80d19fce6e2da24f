"""Several processes train one network, and devices have names."""

import dataclasses
import math
import os

import pytest
import torch

from scenegen.model.checkpoint import load_tensors, save_tensors
from scenegen.model.config import LossConfig
from scenegen.model.network import Network
from scenegen.model.training.device import Group, autocast, resolve_precision
from scenegen.model.training.loop import Step, TrainingError, check_maps
from tests.model.training.runs import SMALL, elsewhere, maps_of
from tests.scenegen.base.slurm_here import free_port


def take_a_step(folders, out, environment):
    """One step from the same first weights, whatever the number of processes; `environment` is what
    torchrun sets."""
    torch.set_num_threads(1)
    os.environ.update(environment)
    device = torch.device("cpu")
    with Group(device) as group:
        maps = maps_of(folders)
        torch.manual_seed(0)
        config = dataclasses.replace(SMALL, loss=LossConfig(eikonal=1.0, lovasz=1.0))
        network = Network(config.network).eval()  # on CPUs, batch norms are each process's own
        optimizer = torch.optim.SGD(network.parameters(), lr=1.0)
        learn = Step(network, optimizer, config, maps.grid, group)
        batch = {name: torch.stack([maps[n][name] for n in range(4)]) for name in maps[0]}
        batch["occupancy"][::2, :, :, 4:] = (
            False  # so that the first process has fewer voxels near surfaces
        )
        losses = learn(
            {name: values[group.rank :: group.size] for name, values in batch.items()}, 1.0
        )
        save_tensors(out / f"{group.rank} of {group.size}", network.state_dict(), losses)


def test_processes_get_equal_shares(folders):
    """Samples that are fewer than a batch are one, which has to divide, too."""
    maps = maps_of(folders)
    processes = len(maps) - 1
    config = dataclasses.replace(SMALL, batch=2 * processes)
    with pytest.raises(
        TrainingError, match=f"do not divide among {processes} processes; give --batch {processes}$"
    ):
        check_maps(maps, maps, config, processes)
    check_maps(maps, maps, dataclasses.replace(SMALL, batch=processes), processes)


def test_two_processes_take_the_step_that_one_takes(folders, tmp_path):
    """Gradients and losses are the whole batch's, and so is the Eikonal term, whose voxels are not
    shared evenly."""
    torchrun = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port())}
    ranks = [
        elsewhere(take_a_step, folders, tmp_path, torchrun | {"RANK": str(rank)})
        for rank in range(2)
    ]
    try:
        take_a_step(folders, tmp_path, {})
        for rank in ranks:
            rank.join(timeout=100)
        assert [rank.exitcode for rank in ranks] == [0, 0]
    finally:
        for rank in ranks:  # one waits long for the other
            rank.kill()
    one, losses = load_tensors(tmp_path / "0 of 1")
    for rank in range(2):
        two, theirs = load_tensors(tmp_path / f"{rank} of 2")
        assert theirs == pytest.approx(losses, rel=1e-5)
        for name, tensor in one.items():
            torch.testing.assert_close(two[name], tensor, atol=1e-6, rtol=1e-5)


def test_maps_of_a_few_cells_are_not_trained_in_bfloat16_unasked():
    """Where every pass is repeated among freed memory full of NaN, gradients stay finite."""
    cpu = torch.device("cpu")
    assert resolve_precision("auto", cpu, (16, 16, 16)) == torch.float32
    assert resolve_precision("bfloat16", cpu, (16, 16, 16)) == torch.bfloat16
    usual = resolve_precision("auto", cpu)
    layer = torch.nn.Conv3d(32, 32, 3, padding=1)
    for _ in range(20):
        junk = [torch.full((1 << size,), math.nan) for size in range(4, 18) for _ in range(6)]
        del junk
        layer.zero_grad()
        with autocast(cpu, usual):
            found = layer(torch.ones(4, 32, 4, 4, 2))  # as many cells as are let pass
        found.float().sum().backward()
        assert layer.weight.grad.isfinite().all()
