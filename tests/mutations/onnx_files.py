"""ONNX files as `scenegen export` lays them out, made without its exporter, which takes seconds."""

import json

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

SHAPE = ("batch", 16, 16, 16)
GRID = {"shape": [16, 16, 16], "voxel_m": 0.2, "truncation_m": 2.0}
NETWORK = {"variant": "proposed", "width": 1, "stem_stride": 2, "heads": 4}


def build_onnx(
    *,
    factors=(4.0, -1.5),
    shifts=(-2.0, 1.5),
    outputs=("logits", "tudf"),
    kind=TensorProto.FLOAT,
    header=None,
    extra=(),
    constants=(),
):
    """A model of as many outputs as named, each a line over the observed voxels."""
    nodes, values, made = [], [], []
    for number, (name, factor, shift) in enumerate(zip(outputs, factors, shifts, strict=False)):
        values += [
            numpy_helper.from_array(np.float32(v), f"{w}{number}")
            for w, v in (("a", factor), ("b", shift))
        ]
        nodes.append(helper.make_node("Mul", ["observed", f"a{number}"], [f"m{number}"]))
        nodes.append(helper.make_node("Add", [f"m{number}", f"b{number}"], [f"s{number}"]))
        nodes.append(helper.make_node("Cast", [f"s{number}"], [name], to=kind))
        made.append(helper.make_tensor_value_info(name, kind, SHAPE))
    graph = helper.make_graph(
        [*nodes, *extra],
        "network",
        [helper.make_tensor_value_info("observed", TensorProto.FLOAT, SHAPE)],
        made,
        [*values, *constants],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    said = {"grid": GRID, "network": NETWORK, "about": {}} if header is None else header
    model.metadata_props.append(
        onnx.StringStringEntryProto(
            key="scenegen", value=said if isinstance(said, str) else json.dumps(said)
        )
    )
    return model


def write_onnx(path, **changes):
    """Such a model as a file."""
    path.write_bytes(build_onnx(**changes).SerializeToString())
