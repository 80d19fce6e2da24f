"""ONNX files say what the network says, in every runtime, and other files are refused."""

from pathlib import Path

import numpy as np
import pytest
import torch

from lidarsim import GridSpec
from model.checkpoint import CheckpointError
from model.completer import Completer
from model.export import export_onnx
from model.network import Network, NetworkConfig
from model.runtime import RUNTIMES, load_onnx

GRID = GridSpec(shape=(16, 24, 8))
pytest.importorskip("onnxscript")


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Network]:
    torch.manual_seed(0)
    network = Network(NetworkConfig(width=4))
    for _ in range(3):  # statistics that are not those of a fresh network
        network.train()(torch.rand(4, *GRID.shape))
    path = tmp_path_factory.mktemp("onnx") / "net.onnx"
    export_onnx(network.eval(), GRID, path, about={"seed": 0})
    return path, network


@pytest.mark.parametrize("runtime", RUNTIMES)
@pytest.mark.parametrize("batch", [1, 3])
def test_runtimes_agree_with_torch(exported: tuple[Path, Network], runtime: str, batch: int) -> None:
    """onnxruntime to rounding; OpenVINO to bfloat16's, which it uses where the processor has it."""
    pytest.importorskip(runtime)
    path, network = exported
    maps = (torch.rand(batch, *GRID.shape) < 0.1).float()
    with torch.no_grad():
        expected = network(maps)
    forward, grid, about = load_onnx(path, runtime=runtime, threads=1)
    assert (grid, about) == (GRID, {"seed": 0})
    found = forward(maps)
    tolerance = 1e-4 if runtime == "onnxruntime" else 5e-2
    torch.testing.assert_close(found.logits, expected.logits, atol=tolerance, rtol=tolerance)
    torch.testing.assert_close(found.tudf, expected.tudf, atol=tolerance, rtol=tolerance)


def test_an_onnx_file_is_a_completer(exported: tuple[Path, Network]) -> None:
    path, network = exported
    observed = np.random.default_rng(0).random(GRID.shape) < 0.1
    found = Completer.from_pretrained(path)(observed)
    with torch.no_grad():
        expected = network(torch.from_numpy(observed[None]).float())
    np.testing.assert_allclose(found.occupancy_probability, expected.logits[0].sigmoid(), atol=2e-2)


def test_other_files_are_refused(tmp_path: Path) -> None:
    import onnx

    (tmp_path / "text.onnx").write_text("no network")
    graph = onnx.helper.make_graph([], "empty", [], [])
    onnx.save(onnx.helper.make_model(graph), tmp_path / "foreign.onnx")
    for name, said in (("text.onnx", "not an ONNX file"), ("foreign.onnx", "not from `scenegen export`")):
        with pytest.raises(CheckpointError, match=said) as caught:
            Completer.from_pretrained(tmp_path / name)
        assert "\n" not in str(caught.value)
