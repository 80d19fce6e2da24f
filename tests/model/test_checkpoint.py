"""Networks survive the disk, and files that hold none are refused without running anything in
them."""

import json
import math
import os
import pickle

import pytest
import torch

from lidarsim import GridSpec
from scenegen.base.limits import MAX_HEADER_BYTES
from scenegen.model.checkpoint import (
    load_network,
    load_tensors,
    save_tensors,
)
from tests.model.conftest import saved_network
from tests.refusals import refuses
from tests.scenegen import each_case

GRID = GridSpec(shape=(16, 16, 8), voxel_m=0.1, truncation_m=1.0)


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "dual.safetensors"
    return path, saved_network(path, GRID, {"seed": 3}, variant="proposed")


def test_what_is_saved_comes_back(saved):
    path, network = saved
    loaded, grid, about = load_network(path)
    assert loaded.config == network.config
    assert grid == GRID
    assert about == {"seed": 3}
    assert not loaded.training
    maps = {"observed": torch.rand(1, *GRID.shape)}
    sent = pickle.loads(pickle.dumps(loaded))  # as other programs may send it
    torch.testing.assert_close(sent(batch=maps)[:2], network(maps)[:2], rtol=0, atol=0)


class Trap:
    """Leaves a file behind when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (self.path, "w")


@pytest.mark.parametrize("save", [torch.save, pickle.dump])
def test_pickles_are_refused_and_not_run(tmp_path, save):
    path = tmp_path / "stranger.safetensors"
    with path.open("wb") as file:
        save({"weights": Trap(str(tmp_path / "sprung"))}, file)
    refuses(save.__name__, load_network, path)
    assert not (tmp_path / "sprung").exists()


@each_case("../model/headers", "change")
def test_headers_that_do_not_fit_are_refused(saved, change):
    path, _ = saved
    tensors, header = load_tensors(path)
    save_tensors(path, tensors, header | json.loads(change))
    refuses(change, load_network, path)


@pytest.mark.parametrize("number", [math.nan, math.inf, 0])
def test_weights_that_are_no_numbers_or_of_another_type_are_refused(saved, number):
    path, _ = saved
    tensors, header = load_tensors(path)
    save_tensors(path, tensors | {"attention.out.bias": torch.tensor([number] * 16)}, header)
    refuses(number, load_network, path)


def header(about):
    """A safetensors file without tensors, whose header holds `about`."""
    text = json.dumps({"__metadata__": {"header": about}}).encode()
    return len(text).to_bytes(8, "little") + text


def test_files_that_hold_no_network_are_refused(saved, tmp_path):
    path, _ = saved
    strange = header("[" * 100_000), header("[1, 2]"), header(" " * (MAX_HEADER_BYTES + 1))
    promise = (1 << 60).to_bytes(8, "little") + b"{}"  # which is not read
    for n, content in enumerate((b"", path.read_bytes()[:-100], b"no network", promise, *strange)):
        path.write_bytes(content)
        assert "dual.safetensors" in refuses(n, load_network, path)
    os.mkfifo(tmp_path / "pipe.safetensors")
    for wrong in (tmp_path / "pipe.safetensors", tmp_path):
        refuses(wrong.suffix, load_network, wrong)
