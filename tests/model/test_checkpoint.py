"""Networks survive the disk, and files that hold none are refused without running anything in
them."""

import json
import math
import os
import pickle

import pytest
import torch

from lidarsim import GridSpec
from scenegen.base.limits import MOST_HEADER_BYTES
from scenegen.model.checkpoint import (
    CheckpointError,
    load_network,
    load_tensors,
    save_tensors,
)
from tests.command_line import rows
from tests.model.conftest import saved_network

GRID = GridSpec(shape=(16, 16, 8), voxel_m=0.1, truncation_m=1.0)


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "dual.safetensors"
    return path, saved_network(path, GRID, {"seed": 3}, variant="proposed")


def test_what_is_saved_comes_back(saved):
    path, network = saved
    found, grid, about = load_network(path)
    assert (found.config, grid, about) == (network.config, GRID, {"seed": 3})
    assert not found.training
    maps = {"observed": torch.rand(1, *GRID.shape)}
    found = pickle.loads(pickle.dumps(found))(batch=maps)  # as other programs may send it
    for one, other in zip(network(maps)[:2], found[:2], strict=True):
        assert torch.equal(one, other)


def test_the_stem_stride_that_earlier_versions_wrote_is_read(saved):
    path, network = saved
    tensors, header = load_tensors(path)
    save_tensors(path, tensors, header | {"network": header["network"] | {"stem_stride": 2}})
    assert load_network(path)[0].config == network.config


class Trap:
    """Leaves a file behind when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (self.path, "w")


@pytest.mark.parametrize("zipped", [True, False])
def test_a_pickle_is_refused_and_not_run(tmp_path, zipped):
    trap = Trap(str(tmp_path / "sprung"))
    path = tmp_path / "stranger.safetensors"
    if zipped:
        torch.save({"weights": trap}, path)
    else:
        path.write_bytes(pickle.dumps(trap))
    with pytest.raises(CheckpointError, match="pickled"):
        load_network(path)
    assert not (tmp_path / "sprung").exists()


HEADERS = """
{"format": "other"}                                → not a network
{"version": 99}                                    → this scenegen reads scenegen-network 1
{"network": {"variant": "occ", "width": 4}}        → do not fit
{"network": {"depth": 3}}                          → do not fit
{"network": {"variant": "proposed", "width": 1024}}    → width = 1024: expected a whole number
{"network": {"variant": "proposed", "width": "4"}}     → width = '4': expected a whole number
{"grid": {"shape": [4096, 4096, 4096], "voxel_m": 0.1, "truncation_m": 1}} → voxels at most
{"grid": {"shape": [1e400, 8, 8], "voxel_m": 0.1, "truncation_m": 1}}      → do not fit
{"network": {"variant": "proposed", "stem_stride": 1}} → stem_stride = 1: networks have 2
{"grid": null}                                     → do not fit
"""


@pytest.mark.parametrize(("change", "named"), rows(HEADERS))
def test_headers_that_do_not_fit_are_refused(saved, tmp_path, change, named):
    tensors, header = load_tensors(saved[0])
    save_tensors(tmp_path / "changed.safetensors", tensors, header | json.loads(change))
    with pytest.raises(CheckpointError, match=named):
        load_network(tmp_path / "changed.safetensors")


def test_weights_that_are_no_numbers_or_of_another_type_are_refused(saved):
    path, _ = saved
    tensors, header = load_tensors(path)
    for values, said in (
        (torch.full((16,), math.nan), r"attention\.out\.bias holds NaN or infinity"),
        (torch.full((16,), math.inf), r"attention\.out\.bias holds NaN or infinity"),
        (torch.zeros(16, dtype=torch.int64), "is torch.int64, expected torch.float32"),
    ):
        save_tensors(path, tensors | {"attention.out.bias": values}, header)
        with pytest.raises(CheckpointError, match=said):
            load_network(path)


def header(about):
    """A safetensors file without tensors, whose header holds `about`."""
    text = json.dumps({"__metadata__": {"header": about}}).encode()
    return len(text).to_bytes(8, "little") + text


def test_files_that_hold_no_network_are_refused(saved, tmp_path):
    path, _ = saved
    strange = header("[" * 100_000), header("[1, 2]"), header(" " * (MOST_HEADER_BYTES + 1))
    promise = (1 << 60).to_bytes(8, "little") + b"{}"  # which is not read
    for content, told in (
        *((one, "damaged") for one in (b"", path.read_bytes()[:-100], b"no network", *strange)),
        (promise, "expected 16777216 at most"),
    ):
        path.write_bytes(content)
        with pytest.raises(CheckpointError, match=rf"dual\.safetensors.*{told}"):
            load_network(path)
    os.mkfifo(tmp_path / "pipe.safetensors")
    for wrong in (tmp_path / "pipe.safetensors", tmp_path):
        with pytest.raises(CheckpointError, match=str(wrong)):
            load_network(wrong)
