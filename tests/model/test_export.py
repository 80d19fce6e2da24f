"""ONNX files say what the network says, in every runtime, and other files are refused."""

import json
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec

import numpy as np
import pytest
import torch

from lidarsim import GridSpec
from scenegen import Completer
from scenegen.model.checkpoint import load_network, save_network
from scenegen.model.config import VARIANTS, NetworkConfig
from scenegen.model.network import Network
from scenegen.model.onnx import RUNTIMES, Traced, export_onnx, load_onnx, read_graph
from tests.refusals import refuses
from tests.scenegen import each_case

GRID = GridSpec(shape=(16, 24, 8))
onnx = pytest.importorskip("onnx")
from tests.mutations.onnx_files import GRID as SMALL_GRID  # noqa: E402
from tests.mutations.onnx_files import LINES, NETWORK, build_onnx  # noqa: E402

pytestmark = pytest.mark.skipif(not find_spec("onnxscript"), reason="needs onnxscript")


def seen(batch):
    """Maps of noise, in another order than the network's."""
    return {name: torch.rand(batch, *GRID.shape) < 0.1 for name in ("free", "observed")}


def trained(**config):
    """A network which sees columns whole, of statistics that are not those of a fresh one."""
    torch.manual_seed(0)
    network = Network(NetworkConfig(width=4, height=GRID.shape[2], **config)).train()
    for _ in range(3):
        network(seen(4))
    return network.eval()


def export(folder):
    """Such a network as a checkpoint, and as ONNX."""
    network = trained(variant="columns", inputs=("observed", "free"))
    save_network(folder / "net.safetensors", network, GRID, {})
    export_onnx(network, GRID, folder / "net.onnx", metadata={"seed": 0})


@pytest.fixture(scope="module")
def exported(once):
    """Such an ONNX file, and its network."""
    folder = once("onnx", export)
    return folder / "net.onnx", load_network(folder / "net.safetensors")[0]


@pytest.fixture(params=RUNTIMES)
def runtime(request):
    pytest.importorskip(request.param)
    return request.param


def test_runtimes_agree_with_torch(exported, runtime):
    """For one map and for several; onnxruntime to rounding, OpenVINO to bfloat16's, where the
    processor has it."""
    path, network = exported
    forward, held = load_onnx(path, runtime=runtime, threads=1)
    assert held.grid == GRID
    assert held.metadata == {"seed": 0}
    assert held.config == network.config
    tolerance = 1e-4 if runtime == "onnxruntime" else 5e-2
    for batch in (1, 3, 1):
        maps = seen(batch)
        with torch.no_grad():
            expected = network(maps)
        torch.testing.assert_close(forward(maps), expected, atol=tolerance, rtol=tolerance)


def test_threads_get_the_answer_to_their_own_map(exported, runtime):
    forward, _ = load_onnx(exported[0], runtime=runtime, threads=1)
    several = [seen(1) for _ in range(24)]
    expected = [forward(maps) for maps in several]
    with ThreadPoolExecutor(4) as threads:
        for answer, alone in zip(threads.map(forward, several), expected, strict=True):
            assert torch.equal(answer.logits, alone.logits)


@pytest.mark.parametrize("variant", VARIANTS)
def test_exports_are_the_network(variant):
    """As a tuple of what it predicts."""
    network, maps = trained(variant=variant), seen(2)
    with torch.no_grad():
        actual = Traced(network).eval()(maps["observed"])
        expected = tuple(network(maps).by_target.values())
    torch.testing.assert_close(tuple(actual), expected, atol=1e-5, rtol=1e-5)


def test_other_files_are_refused(tmp_path):
    (tmp_path / "text.onnx").write_text("no network")
    graph = onnx.helper.make_graph([], "empty", [], [])
    onnx.save(onnx.helper.make_model(graph), tmp_path / "foreign.onnx")
    for name in ("text.onnx", "foreign.onnx"):
        refuses(name, Completer.from_pretrained, tmp_path / name)


def test_other_names_are_refused(exported, tmp_path):
    refuses("net.pt", export_onnx, exported[1], GRID, tmp_path / "net.pt", metadata={})


def test_inputs_and_outputs_go_by_name(tmp_path, runtime):
    """The outputs in the other order; an unused input."""
    network = NETWORK | {"inputs": ["observed", "distance"]}
    model = build_onnx({"grid": SMALL_GRID, "network": network})
    model.graph.input.add(name="distance", type=model.graph.input[0].type)
    outputs = [*model.graph.output]
    del model.graph.output[:]
    model.graph.output.extend(reversed(outputs))
    onnx.save(model, tmp_path / "swapped.onnx")
    forward, _ = load_onnx(tmp_path / "swapped.onnx", runtime=runtime, threads=1)
    maps = torch.arange(2 * 16**3).reshape(2, 16, 16, 16) % 2 == 0
    output = forward({"observed": maps, "distance": ~maps})
    for name, (factor, shift) in LINES.items():
        torch.testing.assert_close(getattr(output, name), factor * maps.float() + shift)


@each_case("../model/onnx_headers", "changes")
def test_headers_that_do_not_fit_are_refused(changes):
    header = {"grid": SMALL_GRID, "network": NETWORK}
    for name, change in json.loads(changes).items():
        header[name] = change and header[name] | change
    refuses(changes, read_graph, build_onnx(header).SerializeToString())


def weight(value, name="weight"):
    return onnx.numpy_helper.from_array(value, name)


def constant(**attribute):
    """A node which no output needs."""
    return onnx.helper.make_node("Constant", [], ["unused"], **attribute)


ADDED = {
    "sparse": ("sparse_initializer", onnx.SparseTensorProto()),
    "NaN": ("initializer", weight(np.float32([np.nan]))),
    "inf": ("initializer", weight(np.float32([np.inf]))),
    "NaN of a half": ("initializer", weight(np.float16([np.nan]))),
    "NaN of a constant": ("node", constant(value=weight(np.float32(np.nan)))),
    "NaN of a node": ("node", constant(value_float=np.nan)),
    "NaN in a list": ("node", constant(value_floats=[0.0, np.nan])),
    "loop": ("node", onnx.helper.make_node("Loop", [], [])),
    "cut weight": ("initializer", onnx.TensorProto(name="cut", data_type=1, dims=[2])),
    "parts elsewhere": ("initializer", onnx.TensorProto(data_location=1)),
}


@pytest.mark.parametrize("part", ADDED)
def test_what_no_export_holds_is_refused(part):
    """Numbers that are none, too, whether or not what an empty map gives shows it."""
    model = build_onnx()
    name, added = ADDED[part]
    getattr(model.graph, name).append(added)
    refuses(part, read_graph, model.SerializeToString())


def test_code_may_compare_with_infinity():
    model = build_onnx()
    model.graph.node.append(constant(value=weight(np.float32(np.inf))))
    read_graph(model.SerializeToString())


def fix_the_batch(graph):
    graph.input[0].type.tensor_type.shape.dim[0].dim_value = 1


def divide_by_zero(graph):
    graph.node[1].op_type = "Div"
    graph.initializer[1].CopyFrom(weight(np.float32(0), graph.initializer[1].name))


@pytest.mark.parametrize("change", [fix_the_batch, divide_by_zero])
def test_completions_that_are_none_are_refused(tmp_path, change):
    pytest.importorskip("onnxruntime")
    model, path = build_onnx(), tmp_path / "changed.onnx"
    change(model.graph)
    onnx.save(model, path)
    refuses(change.__name__, load_onnx, path, runtime="onnxruntime")
