"""Several processes train one network, and devices have names."""

import os

import pytest
import torch

from scenegen.model.checkpoint import load_tensors, save_tensors
from scenegen.model.config import LossConfig
from scenegen.model.network import Network
from scenegen.model.training.device import Group, resolve_precision
from scenegen.model.training.loop import Step, check_maps
from tests.model.training.runs import elsewhere, maps_of, small
from tests.refusals import refuses
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
        config = small(loss=LossConfig(eikonal=1.0, lovasz=1.0))
        network = Network(config.network).eval()  # on CPUs, batch norms are each process's own
        optimizer = torch.optim.SGD(network.parameters(), lr=1.0)
        learn = Step(network, optimizer, config, maps.grid, group)
        batch = {name: torch.stack([maps[n][name] for n in range(4)]) for name in maps[0]}
        # so that the first process has fewer voxels near surfaces
        batch["occupancy"][::2, :, :, 4:] = False
        share = {name: values[group.rank :: group.size] for name, values in batch.items()}
        losses = learn(share, 1.0)
        save_tensors(out / f"{group.rank} of {group.size}", network.state_dict(), losses)


def test_processes_get_equal_shares(folders):
    """Samples that are fewer than a batch are one, which has to divide, too."""
    maps = maps_of(folders)
    processes = len(maps) - 1
    config = small(batch=2 * processes)
    refuses("too few", check_maps, maps, maps, config, processes)
    check_maps(maps, maps, small(batch=processes), processes)


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
    expected, expected_losses = load_tensors(tmp_path / "0 of 1")
    torch.manual_seed(0)
    before = Network(small().network).named_parameters()
    assert any(not torch.equal(expected[name], weight) for name, weight in before)
    for rank in range(2):
        weights, losses = load_tensors(tmp_path / f"{rank} of 2")
        assert losses == pytest.approx(expected_losses, rel=1e-5)
        torch.testing.assert_close(dict(weights), dict(expected), atol=1e-6, rtol=1e-5)


def test_small_maps_are_trained_in_float32(monkeypatch):
    """oneDNN has NaN in gradients of so few cells; unless bfloat16 is asked for."""
    monkeypatch.setattr("scenegen.model.training.device.prefers_bfloat16", lambda: True)
    cpu = torch.device("cpu")
    assert resolve_precision("auto", cpu, (16, 16, 16)) == torch.float32
    assert resolve_precision("bfloat16", cpu, (16, 16, 16)) == torch.bfloat16
    assert resolve_precision("auto", cpu) == torch.bfloat16
