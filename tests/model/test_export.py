"""ONNX files say what the network says, in every runtime, and other files are refused."""

import json
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib.util import find_spec

import numpy as np
import pytest
import torch

from lidarsim import GridSpec
from scenegen.model.checkpoint import CheckpointError, load_network, save_network
from scenegen.model.completion.completer import Completer
from scenegen.model.config import VARIANTS, NetworkConfig
from scenegen.model.network import Network
from scenegen.model.onnx import RUNTIMES, Traced, export_onnx, load_onnx
from tests.refusals import refuses

GRID = GridSpec(shape=(16, 24, 8))
pytestmark = pytest.mark.skipif(not find_spec("onnxscript"), reason="needs onnxscript")


def seen(batch):
    """Maps of noise, in another order than the network's."""
    return {name: torch.rand(batch, *GRID.shape) < 0.1 for name in ("free", "observed")}


def export(folder, variant, inputs):
    """A network which sees columns whole: as a checkpoint, and as ONNX."""
    torch.manual_seed(0)
    config = NetworkConfig(variant=variant, width=4, inputs=inputs, height=GRID.shape[2])
    network = Network(config)
    for _ in range(3):  # statistics that are not those of a fresh network
        network.train()(seen(4))
    save_network(folder / "net.safetensors", network, GRID, {})
    export_onnx(network.eval(), GRID, folder / "net.onnx", metadata={"seed": 0})


@pytest.fixture(
    scope="module",
    params=["columns observed free"],
)
def exported(once, request):
    """Such an ONNX file, and its network."""
    variant, *inputs = request.param.split()
    folder = once(f"onnx-{variant}", partial(export, variant=variant, inputs=tuple(inputs)))
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
    assert (held.grid, held.metadata, held.config) == (GRID, {"seed": 0}, network.config)
    tolerance = 1e-4 if runtime == "onnxruntime" else 5e-2
    for batch in (1, 3, 1):
        maps = seen(batch)
        with torch.no_grad():
            expected = network(maps)
        found = forward(maps)
        torch.testing.assert_close(found, expected, atol=tolerance, rtol=tolerance)


def test_threads_get_the_answer_to_their_own_map(exported, runtime):
    forward, _ = load_onnx(exported[0], runtime=runtime, threads=1)
    asked = [seen(1) for _ in range(24)]
    expected = [forward(maps) for maps in asked]
    with ThreadPoolExecutor(4) as threads:
        for found, alone in zip(threads.map(forward, asked), expected, strict=True):
            assert torch.equal(found.logits, alone.logits)


@pytest.mark.parametrize("variant", VARIANTS)
def test_what_is_exported_is_the_network(variant):
    """As a tuple of what it predicts."""
    torch.manual_seed(0)
    network = Network(NetworkConfig(variant=variant, width=4, height=GRID.shape[2]))
    network.train()(seen(2))  # whose statistics differ from head to head
    maps, traced = seen(2)["observed"], Traced(network).eval()
    with torch.no_grad():
        found, expected = traced(maps), network({"observed": maps})
    for one, other in zip(found, expected.by_target.values(), strict=True):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-5)


def test_other_files_and_names_are_refused(exported, tmp_path):
    import onnx

    (tmp_path / "text.onnx").write_text("no network")
    graph = onnx.helper.make_graph([], "empty", [], [])
    onnx.save(onnx.helper.make_model(graph), tmp_path / "foreign.onnx")
    for name in ("text.onnx", "foreign.onnx"):
        refuses(name, Completer.from_pretrained, tmp_path / name, error=CheckpointError)
    more = {"metadata": {}, "error": CheckpointError}
    refuses("net.pt", export_onnx, exported[1], GRID, tmp_path / "net.pt", **more)


def changed(path, change):
    """The file at `path` after a `change` of its model."""
    import onnx

    model = onnx.load(str(path))
    change(model)
    return model.SerializeToString()


def swap_outputs(model):
    """The two outputs in the other order, under their own names; an unused input."""
    model.graph.input.add(name="distance", type=model.graph.input[0].type)
    inputs = [one.name for one in model.graph.input]
    set_header(network={"variant": "columns", "height": 8, "inputs": inputs})(model)
    first, second = model.graph.output
    kept = first.SerializeToString()
    first.CopyFrom(second)
    second.ParseFromString(kept)


def test_inputs_and_outputs_go_by_name_and_not_by_place(exported, tmp_path, runtime):
    path = tmp_path / "swapped.onnx"
    path.write_bytes(changed(exported[0], swap_outputs))
    maps = seen(1)
    maps["distance"] = maps["free"]
    straight, swapped = (
        load_onnx(one, runtime=runtime, threads=1)[0](maps) for one in (exported[0], path)
    )
    torch.testing.assert_close(swapped, straight)


def fix_the_batch(model):
    for one in (*model.graph.input, *model.graph.output):
        one.type.tensor_type.shape.dim[0].dim_value = 1


def set_header(**values):
    def change(model):
        entry = next(entry for entry in model.metadata_props if entry.key == "scenegen")
        entry.value = json.dumps({**json.loads(entry.value), **values})

    return change


def set_weight(value, name, kind=np.float32):
    """A change that sets the first number of a weight, which may become of another type."""

    def change(model):
        import onnx

        tensor = next(one for one in model.graph.initializer if one.name == name)
        values = onnx.numpy_helper.to_array(tensor).astype(kind)
        values.flat[0] = value
        tensor.CopyFrom(onnx.numpy_helper.from_array(values, name))

    return change


def overflow(model):
    """Finite weights, of which each layer's sums are larger than the last's."""
    import onnx

    for tensor in model.graph.initializer:
        if tensor.dims and tensor.data_type == onnx.TensorProto.FLOAT:
            large = np.full(tensor.dims, 1e30, np.float32)
            tensor.CopyFrom(onnx.numpy_helper.from_array(large, tensor.name))


def cut_weight(model):
    tensor = model.graph.initializer[0]
    tensor.raw_data = tensor.raw_data[:-4]


def add_node(**attribute):
    """A change that adds a node which no output needs, with an attribute."""

    def change(model):
        import onnx

        model.graph.node.append(onnx.helper.make_node("Constant", [], ["unused"], **attribute))

    return change


def add_sparse(model):
    import onnx

    values = onnx.numpy_helper.from_array(np.float32([np.nan]), "sparse")
    places = onnx.numpy_helper.from_array(np.int64([0]))
    model.graph.sparse_initializer.append(onnx.helper.make_sparse_tensor(values, places, [2]))


def rename_input(model):
    """As one byte of the file that became 0 does it for a runtime that reads names in C."""
    each = next(each for each in model.graph.input if each.name == "free")
    for node in model.graph.node:
        node.input[:] = ["f" if name == "free" else name for name in node.input]
    each.name = "f"


def rename_outputs(model):
    for output in model.graph.output:
        output.name += "x"


def point_outside(model):
    tensor = model.graph.initializer[0]
    tensor.data_location = 1
    tensor.ClearField("raw_data")
    entry = tensor.external_data.add()
    entry.key, entry.value = "location", "/etc/passwd"


def header_of_brackets(model):
    model.metadata_props[-1].value = "[" * 100_000


CHANGES = {
    "overflow": overflow,
    "fixed batch": fix_the_batch,
    "other outputs": rename_outputs,
    "parts elsewhere": point_outside,
    "sparse": add_sparse,
    "no network": set_header(network=None),
    "other inputs": set_header(network={"width": 4, "inputs": ["distance"]}),
    "renamed input": rename_input,
    "cut weight": cut_weight,
    "short grid": set_header(grid={"shape": [8, 8]}),
    "brackets": header_of_brackets,
    # OpenVINO's maps stay finite with the first, and all runtimes' with the second
    "NaN": set_weight(np.nan, "network.columns.down.0.0.weight"),
    "NaN cast": set_weight(np.nan, "threshold_cast"),
    "inf": set_weight(np.inf, "network.columns.stem.0.weight_bias"),
    "NaN of a half": set_weight(np.nan, "network.head.tudf.split.weight", np.float16),
    "NaN of a node": add_node(value_float=np.nan),
    "NaN in a list": add_node(value_floats=[0.0, np.nan]),
}


@pytest.mark.parametrize("change", CHANGES)
def test_what_no_export_holds_is_refused(exported, tmp_path, change):
    """Numbers that are none, too, whether or not what an empty map gives shows it."""
    pytest.importorskip("onnxruntime")
    path = tmp_path / "changed.onnx"
    path.write_bytes(changed(exported[0], CHANGES[change]))
    refuses(change, load_onnx, path, runtime="onnxruntime", error=CheckpointError)


def test_code_of_a_network_may_compare_with_infinity(exported, tmp_path, runtime):
    import onnx

    path, infinite = tmp_path / "infinite.onnx", np.array(np.inf, np.float32)
    path.write_bytes(changed(exported[0], add_node(value=onnx.numpy_helper.from_array(infinite))))
    load_onnx(path, runtime=runtime, threads=1)
