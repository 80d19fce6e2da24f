"""ONNX files: examined in a process with limits, then run by a CPU runtime; OpenVINO is faster than torch."""

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from threading import Lock
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lidarsim import GridSpec
from scenegen.errors import DatasetError, GuardError, needs, printable
from scenegen.files import read_bounded
from scenegen.limits import GUARD_BYTES, GUARD_S, MOST_WEIGHTS_BYTES
from scenegen.model.checkpoint import CheckpointError, network_from
from scenegen.model.config import NetworkConfig
from scenegen.model.network import Output
from scenegen.workers import guarded

NAMES = {"occupancy": "logits", "tudf": "tudf"}
"""Outputs of an ONNX file, by task."""
HEADER = "scenegen"
"""Key of the file's metadata under which grid, variant and origin stand, as JSON."""
OPERATIONS = frozenset(
    {
        *("Add", "BatchNormalization", "Cast", "Concat", "Constant", "Conv", "ConvTranspose", "Div"),
        *("Gather", "Greater", "Identity", "LayerNormalization", "LeakyRelu", "MatMul"),
        *("Mul", "Neg", "Pow", "ReduceMean", "Relu", "Reshape", "Shape", "Sigmoid", "Slice", "Softmax"),
        *("Softplus", "Split", "Sqrt", "Squeeze", "Sub", "Transpose"),
        *("Unsqueeze", "Where"),
    }
)
"""What torch's exporter makes of a network: nothing that loops, and nothing that makes large tensors of small ones."""
BYTES_A_FEATURE = 100
"""What a runtime takes for one map, at most: bytes a voxel and channel at the first level."""
Runtime = Literal["openvino", "onnxruntime"]
RUNTIMES: tuple[Runtime, ...] = ("openvino", "onnxruntime")
"""Fastest first (docs/training.md)."""
Run = Callable[[Mapping[str, NDArray[np.float32]]], Sequence[Any]]
"""From a named batch to the outputs, in their order."""


def load_onnx(
    path: Path, *, runtime: Runtime | None = None, threads: int = 0
) -> tuple[Callable[[Mapping[str, Tensor]], Output], "Examined"]:
    """A function from a named batch, (B, *grid.shape) each, to its `Output`, and what the file holds.

    It runs on `threads` threads, 0 for all cores, by the fastest runtime that is installed, unless `runtime` names one:
    OpenVINO computes in bfloat16 where the processor can, onnxruntime in float32. Raises CheckpointError for a file
    that `export_onnx` did not write; see `examine`.
    """
    content, found = examine(path, runtime)
    run = _open(content, found, threads)

    def forward(batch: Mapping[str, Tensor]) -> Output:
        given = {name: batch[name].float().numpy(force=True) for name in found.config.inputs}
        shape = given[found.config.inputs[0]].shape
        values = dict(zip(found.outputs, run(given), strict=True))
        for name, value in values.items():
            if value.shape != shape:
                raise CheckpointError(f"{path}: {name} has shape {value.shape} for maps of {shape}")
        logits, tudf = (torch.from_numpy(values[name]) if name in values else None for name in NAMES.values())
        return Output(logits, tudf)

    return forward, found


@dataclass(frozen=True, kw_only=True)
class Examined:
    """An ONNX file that may be opened in this process."""

    runtime: Runtime
    config: NetworkConfig
    grid: GridSpec
    about: dict[str, Any]

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the file's outputs."""
        return tuple(name for task, name in NAMES.items() if task in self.config.tasks)


def examine(path: Path, runtime: Runtime | None = None) -> tuple[bytes, Examined]:
    """The content of an ONNX file, and what it holds, once it has completed an empty map elsewhere.

    Two processes with limits look at the file first, once for each content: one reads its operations and its weights,
    the other runs it. That costs a second with OpenVINO, half of one with onnxruntime. Raises CheckpointError for a
    file that `export_onnx` did not write, that holds NaN, or that no installed runtime runs within the limits.
    """
    try:
        content = read_bounded(path, MOST_WEIGHTS_BYTES)
        return content, _examined(content, runtime)
    except FileNotFoundError:
        raise CheckpointError(f"{path}: no such file; write one with `scenegen export`") from None
    except DatasetError as error:
        raise CheckpointError(str(error)) from None
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {error}") from None


@cache  # processes that are forked from here have no need, and no leave, to start others
def _examined(content: bytes, runtime: Runtime | None) -> Examined:
    if find_spec("onnx") is None:
        raise CheckpointError(needs("onnx", "export"))
    usable = [name for name in ((runtime,) if runtime else RUNTIMES) if find_spec(name) is not None]
    if not usable:
        raise CheckpointError(needs(runtime or " or ".join(RUNTIMES), "export"))
    try:
        header = guarded(read_graph, content, seconds=GUARD_S, memory_bytes=GUARD_BYTES + 4 * len(content))
    except GuardError as error:
        raise CheckpointError(f"is not an ONNX file that can be read ({error})") from None
    config, grid = network_from(header)
    found = Examined(runtime=usable[0], config=config, grid=grid, about=header["about"])
    features = config.width * int(np.prod(grid.shape))
    memory = GUARD_BYTES + 4 * len(content) + BYTES_A_FEATURE * features
    try:
        guarded(_try, (content, found), seconds=GUARD_S + features / 1e6, memory_bytes=memory)
    except GuardError as error:
        raise CheckpointError(f"{usable[0]} cannot run it: {error}") from None
    return found


def read_graph(content: bytes) -> dict[str, Any]:
    """The header of an ONNX file, once its operations, names and weights are those of an exported network.

    Raises CheckpointError where they are not.
    """
    import onnx

    try:
        model = onnx.load_model_from_string(content)
        weights = {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
    except Exception as error:  # protobuf's errors share no base
        raise CheckpointError(f"is not an ONNX file ({printable(error)[:200]})") from None
    headers = [entry.value for entry in model.metadata_props if entry.key == HEADER]
    if not headers:
        raise CheckpointError("an ONNX file that is not from `scenegen export`; its grid is unknown")
    try:
        header = dict(json.loads(headers[-1]))
        config, _ = network_from(header)
        header["about"] = dict(header.get("about", {}))
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise CheckpointError(f"its header is damaged ({printable(error)[:200]}); export it again") from None
    graph = model.graph
    odd = sorted({node.op_type for node in graph.node if node.op_type not in OPERATIONS or node.domain})
    if odd or model.functions or graph.sparse_initializer or _sizes_depend_on_values(graph, weights):
        raise CheckpointError(f"holds operations that no export has ({printable(odd)[:100]}); export it again")
    for name, values in weights.items():
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise CheckpointError(f"{printable(name)[:100]} holds NaN or infinity; export it again")
    wanted = set(config.inputs), {name for task, name in NAMES.items() if task in config.tasks}
    named = {one.name for one in graph.input} - set(weights), {one.name for one in graph.output}
    if named != wanted:
        shown = [", ".join(sorted(names)) or "nothing" for names in (*named, *wanted)]
        raise CheckpointError(
            f"maps {printable(shown[0])[:100]} to {printable(shown[1])[:100]}, expected {shown[2]} to {shown[3]}; "
            "export it again"
        )
    if any(one.type.tensor_type.shape.dim[0].dim_value for one in graph.input if one.name in wanted[0]):
        raise CheckpointError("takes a fixed number of maps at a time, expected any number; export it again")
    return header


def _sizes_depend_on_values(graph: Any, weights: dict[str, NDArray[Any]]) -> bool:
    """Whether a shape may depend on what a map holds: a map of zeros would then not show what another map takes."""
    whole = {name for name, values in weights.items() if values.dtype.kind in "iu"}
    for node in graph.node:  # in order: what a node reads was made before it
        inputs = node.input[1:] if node.op_type == "Where" else node.input[:1]
        if whole.intersection(inputs):
            if node.op_type == "Where":
                return True
            whole.update(node.output)
        elif node.op_type == "Shape":
            whole.update(node.output)
    return False


def _try(task: tuple[bytes, Examined]) -> None:
    """Complete an empty map. Raises CheckpointError where the file cannot."""
    content, found = task
    try:
        run = _open(content, found, threads=1)
        values = run({name: np.zeros((1, *found.grid.shape), np.float32) for name in found.config.inputs})
    except Exception as error:  # each runtime has its own
        raise CheckpointError(f"{found.runtime} cannot run it: {printable(error)[:200]}") from None
    for name, value in zip(found.outputs, values, strict=True):
        if value.shape != (1, *found.grid.shape) or value.dtype != np.float32:
            raise CheckpointError(
                f"{name} is {value.dtype} of shape {value.shape}, expected float32 of {(1, *found.grid.shape)}; "
                "export it again"
            )


def _open(content: bytes, found: Examined, threads: int) -> Run:
    if found.runtime == "onnxruntime":
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 4  # what goes wrong is raised
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        return lambda batch: session.run(list(found.outputs), dict(batch))
    sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type] # it would report every import
    import openvino

    hints = {"PERFORMANCE_HINT": "LATENCY"} | ({"INFERENCE_NUM_THREADS": threads} if threads else {})
    core = openvino.Core()

    @cache
    def compiled(alone: bool) -> Any:
        """For one map, which is faster where it is known that there is one, or for any number."""
        model = core.read_model(content, b"")
        if alone:
            model.reshape(dict.fromkeys(found.config.inputs, (1, *found.grid.shape)))
        return core.compile_model(model, "CPU", hints)

    one_at_a_time = Lock()  # a compiled network holds the values of its last run

    def run(batch: Mapping[str, NDArray[np.float32]]) -> Sequence[Any]:
        with one_at_a_time:
            values = compiled(len(next(iter(batch.values()))) == 1)(dict(batch))
            return [np.array(values[name]) for name in found.outputs]

    compiled(True)  # now, and not when the first map comes
    return run
