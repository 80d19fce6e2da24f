"""ONNX files as `scenegen export` lays them out, made without its exporter, which takes seconds."""

import json

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

SHAPE = ("batch", 16, 16, 16)
GRID = {"shape": [16, 16, 16], "voxel_m": 0.2, "truncation_m": 2.0}
NETWORK = {"variant": "proposed", "width": 1, "heads": 4}


LINES = {"logits": (4.0, -2.0), "tudf": (-1.5, 1.5)}
"""What each output multiplies the observed voxels by, and adds."""


def build_onnx(header=None):
    """A model whose outputs are lines over the observed voxels."""
    nodes, values = [], []
    for name, line in LINES.items():
        factor, shift = f"{name} factor", f"{name} shift"
        values += [
            numpy_helper.from_array(np.float32(value), one)
            for one, value in zip((factor, shift), line, strict=True)
        ]
        nodes.append(helper.make_node("Mul", ["observed", factor], [f"{name} scaled"]))
        nodes.append(helper.make_node("Add", [f"{name} scaled", shift], [name]))
    seen, *made = (
        helper.make_tensor_value_info(name, TensorProto.FLOAT, SHAPE)
        for name in ("observed", *LINES)
    )
    graph = helper.make_graph(nodes, "network", [seen], made, values)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    said = {"grid": GRID, "network": NETWORK, "about": {}} if header is None else header
    model.metadata_props.append(onnx.StringStringEntryProto(key="scenegen", value=json.dumps(said)))
    return model


def write_onnx(path):
    """Such a model as a file."""
    path.write_bytes(build_onnx().SerializeToString())
