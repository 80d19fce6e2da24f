"""ONNX files: written by `export_onnx`; examined in a process with limits, then run by a CPU
runtime. OpenVINO is faster than torch."""

import json
import logging
import sys
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import redirect_stderr
from dataclasses import asdict, dataclass
from functools import cache
from importlib.util import find_spec
from io import StringIO
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lidarsim.grid import Field, GridSpec
from scenegen.base.errors import GuardError, needs, printable, reraise_as
from scenegen.base.files import Json, check_ours, write_result
from scenegen.base.limits import GUARD_BYTES, GUARD_S, MAX_WEIGHTS_BYTES
from scenegen.base.reading import read_bounded
from scenegen.base.workers import guarded
from scenegen.model.checkpoint import CheckpointError, check_own, network_from
from scenegen.model.config import VARIANTS, NetworkConfig, target_name
from scenegen.model.network import Batch, Output, prefers_bfloat16

NAMES = {"occupancy": "logits", "tudf": "tudf"}
"""Outputs of an ONNX file, by task; others are called as their `target_name`."""
HEADER = "scenegen"
"""Key of the file's metadata under which grid, variant and origin stand, as JSON."""
LOOPS = frozenset({"If", "Loop", "Scan", "SequenceMap"})
"""Operations that another map may have run without end; no export has any."""
BYTES_A_FEATURE = 100
"""What a runtime takes for two maps, at most: bytes a voxel and channel at the first level."""
RUNTIMES = ("openvino", "onnxruntime")
"""Fastest first (docs/complete.md)."""
Run = Callable[[Mapping[str, Field]], Sequence[Any]]
"""From a named batch to the outputs, in their order."""


def load_onnx(
    path: Path, *, runtime: str | None = None, threads: int = 0, own: Collection[str] = ()
) -> tuple[Callable[[Batch], Output], "Examined"]:
    """A function from a named batch, (B, *grid.shape) each, to its `Output`, and what the file
    holds.

    It runs on `threads` threads, 0 for all cores, by the fastest runtime that is installed, unless
    `runtime` names one: OpenVINO computes in bfloat16 where that is faster, onnxruntime in float32.
    Raises CheckpointError for a file that `export_onnx` did not write, and for inputs of a user's
    own that are not in `own`.

    Two processes with limits look at the file first, once for each content: one reads it, the
    other completes an empty map. That costs a second with OpenVINO, half of one with onnxruntime.
    Raises CheckpointError, too, where its weights or what it gives are NaN, and where no installed
    runtime runs it within the limits.
    """
    content = read_bounded(path, MAX_WEIGHTS_BYTES)
    with reraise_as(CheckpointError, f"{path}: ", of=CheckpointError):
        file = _examined(content, runtime)
    check_own(path, own, *file.config.inputs, *file.config.targets)
    run = _open(content, file, threads)

    def forward(batch: Batch) -> Output:
        values = run({name: batch[name].float().numpy(force=True) for name in file.config.inputs})
        by_name = dict(zip(file.outputs, map(torch.from_numpy, values), strict=True))
        logits, tudf = (by_name.pop(name, None) for name in NAMES.values())
        return Output(logits, tudf, by_name)

    return forward, file


@dataclass(frozen=True)
class Examined:
    """An ONNX file that may be opened in this process."""

    runtime: str
    config: NetworkConfig
    grid: GridSpec
    about: Json
    outputs: tuple[str, ...]
    """Names of the file's outputs."""


@cache  # processes that are forked from here have no need, and no leave, to start others
def _examined(content: bytes, runtime: str | None) -> Examined:
    if find_spec("onnx") is None:
        raise CheckpointError(needs("onnx", "export"))
    usable = [name for name in ((runtime,) if runtime else RUNTIMES) if find_spec(name) is not None]
    if not usable:
        raise CheckpointError(needs(runtime or " or ".join(RUNTIMES), "export"))
    memory = GUARD_BYTES + 4 * len(content)
    try:
        graph = guarded(read_graph, content, seconds=GUARD_S, memory_bytes=memory)
    except GuardError as error:
        raise CheckpointError(f"is not an ONNX file that can be read ({error})") from None
    file = Examined(usable[0], *graph)
    features = file.config.width * int(np.prod(file.grid.shape))
    memory += BYTES_A_FEATURE * features
    try:
        guarded(_try, (content, file), seconds=GUARD_S + features / 1e6, memory_bytes=memory)
    except GuardError as error:
        raise CheckpointError(f"{usable[0]} cannot run it: {error}; export it again") from None
    return file


def read_graph(content: bytes) -> tuple[NetworkConfig, GridSpec, Json, tuple[str, ...]]:
    """What `Examined` tells of an ONNX file.

    Raises CheckpointError where it has none, loops, or is not whole, and what `onnx` does.
    """
    import onnx

    model = onnx.load_model_from_string(content)
    headers = [entry.value for entry in model.metadata_props if entry.key == HEADER]
    if not headers:
        raise CheckpointError(
            "an ONNX file that is not from `scenegen export`; its grid is unknown"
        )
    try:
        header = dict(json.loads(headers[-1]))
        (config, grid), about = network_from(header), dict(header.get("about", {}))
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise CheckpointError(
            f"its header is damaged ({printable(error)[:200]}); export it again"
        ) from None
    graph = model.graph
    attributes = [each for node in graph.node for each in node.attribute]
    tensors = [
        *graph.initializer,
        *(each.t for each in attributes),
        *(tensor for each in attributes for tensor in each.tensors),
    ]
    odd = sorted({node.op_type for node in graph.node if node.op_type in LOOPS or node.domain})
    elsewhere = any(tensor.data_location for tensor in tensors)
    sparse = graph.sparse_initializer or any(
        each.HasField("sparse_tensor") or each.sparse_tensors for each in attributes
    )
    if odd or model.functions or elsewhere or sparse:
        raise CheckpointError(
            "has loops, sparse tensors or parts elsewhere, which no export has "
            f"({printable(odd)[:100]})"
        )
    inputs = [each.name for each in graph.input]
    if sorted(inputs) != sorted(config.inputs):
        raise CheckpointError(
            f"takes {printable(', '.join(inputs))[:100] or 'nothing'}, where its header says "
            f"{', '.join(config.inputs)}; export it again"
        )
    _check_numbers(graph, tensors)
    outputs = {output.name for output in graph.output}
    others = [*map(target_name, config.targets)]
    tasks = [task for task in (*NAMES, *others) if NAMES.get(task, task) in outputs]
    variant = VARIANTS.get(config.variant)  # a network of the user's own says what it likes
    expected = {*(variant.tasks if variant else tasks), *others}
    if set(tasks) != expected:
        raise CheckpointError(
            f"gives {' and '.join(tasks) or 'nothing'}, where {config.variant} gives "
            f"{' and '.join(sorted(expected))}; export it again"
        )
    return config, grid, about, tuple(NAMES.get(task, task) for task in tasks)


def _check_numbers(graph: Any, tensors: Sequence[Any]) -> None:
    """Raise CheckpointError where a number of a graph is NaN, or infinite. A single infinity among
    the constants of code is none of the weights, and allowed."""
    import onnx

    for tensor in tensors:
        name = printable(tensor.name)[:100] or "a constant"
        damaged = (ValueError, TypeError, KeyError)
        with reraise_as(CheckpointError, f"{name} is damaged (", "); export it again", of=damaged):
            values = onnx.numpy_helper.to_array(tensor) if tensor.data_type else np.zeros(0)
        if values.dtype.kind == "V":  # bfloat16 and shorter types, which NumPy does not have
            values = values.astype(np.float32)
        if values.dtype.kind in "fc" and (
            np.isnan(values).any() or (values.ndim and np.isinf(values).any())
        ):
            raise CheckpointError(f"{name} holds NaN or infinity; train it again")
    for node in graph.node:
        if any(np.isnan([each.f, *each.floats]).any() for each in node.attribute):
            raise CheckpointError(
                f"{printable(node.name)[:100]} has an attribute that is NaN; export it again"
            )


def _try(task: tuple[bytes, Examined]) -> None:
    """Complete two empty maps. Raises CheckpointError where what comes is no completion, and what
    the runtime does."""
    content, file = task
    shape = (2, *file.grid.shape)  # a file may take one alone
    run = _open(content, file, threads=1)
    values = run({name: np.zeros(shape, np.float32) for name in file.config.inputs})
    good = []
    for name, value in zip(file.outputs, values, strict=True):
        channels = file.config.channels_of(name)
        expected = (2, *[channels] * (channels > 1), *file.grid.shape)
        finite = value.dtype == np.float32 and np.isfinite(value).all()
        good.append(value.shape == expected and finite)
    if not good or not all(good):
        raise CheckpointError(
            f"gives other than {' and '.join(NAMES.values())}, finite, float32, {shape}; export "
            f"it again"
        )


def _open(content: bytes, found: Examined, threads: int) -> Run:
    if found.runtime == "onnxruntime":
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 4  # what goes wrong is raised
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        return lambda batch: session.run(list(found.outputs), dict(batch))
    # it would report every import
    sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]
    import openvino

    hints = {
        "PERFORMANCE_HINT": "LATENCY",
        "INFERENCE_PRECISION_HINT": "bf16" if prefers_bfloat16() else "f32",
        "INFERENCE_NUM_THREADS": threads,
    }
    core = openvino.Core()

    @cache
    def compiled(alone: bool) -> Any:
        """For one map, which is faster where it is known that there is one, or for any number."""
        model = core.read_model(content, b"")
        if alone:
            model.reshape(dict.fromkeys(model.inputs, (1, *found.grid.shape)))
        return core.compile_model(model, "CPU", hints)

    one_at_a_time = Lock()  # a compiled network holds the values of its last run

    def run(batch: Mapping[str, Field]) -> Sequence[Any]:
        with one_at_a_time:
            network = compiled(len(next(iter(batch.values()))) == 1)
            # OpenVINO has dropped inputs that the network does not use
            values = network([batch[each.any_name] for each in network.inputs])
            return [np.array(values[name]) for name in found.outputs]

    compiled(True)  # now, and not when the first map comes
    return run


class Traced(nn.Module):
    """A network whose output is a plain tuple, as tracing wants it."""

    def __init__(self, network: Any):
        super().__init__()
        self.network = network

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """The network's inputs in their order, (B, X, Y, Z) each → its outputs, those of
        `NAMES`."""
        output = self.network(dict(zip(self.network.config.inputs, inputs, strict=True)))
        return tuple(Output(*output).by_target.values())


def export_onnx(network: Any, grid: GridSpec, path: Path, *, about: Json) -> None:
    """Write `network` as ONNX: its inputs by name, float32 (B, *grid.shape) each → ``logits``
    and/or ``tudf``, the same shape, and other targets by their `target_name`.

    Raises CheckpointError for a name that does not end in .onnx, where onnx is not installed, and
    for a network that torch cannot export, or that has loops; DatasetError where the disk refuses.
    """
    if path.suffix != ".onnx":  # by its name it is read again, too
        raise CheckpointError(
            f"{path}: networks are exported as ONNX; give a name that ends in .onnx"
        )
    if getattr(network, "draws", False):  # a runtime's random numbers have no seed
        raise CheckpointError(
            f"variant {network.config.variant}: draws its answers; only networks that do not are "
            "exported"
        )
    check_ours(path)  # an export takes seconds
    try:
        import onnx
        import onnxscript  # noqa: F401 (torch's exporter imports it)
    except ImportError:
        needed = needs("onnx and onnxscript", "export")
        raise CheckpointError(f"{path}: exporting {needed}") from None
    inputs, batch = network.config.inputs, torch.export.Dim("batch", min=1, max=4096)
    with warnings.catch_warnings(), redirect_stderr(StringIO()):  # it prints what fails
        warnings.simplefilter("ignore")  # of torch's own code, and of an absent torchvision
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        try:
            program: Any = torch.onnx.export(
                Traced(network.cpu()).eval(),
                tuple(torch.zeros(2, *grid.shape) for _ in inputs),
                input_names=list(inputs),
                output_names=[NAMES.get(name, name) for name in network.targets],
                dynamic_shapes=(tuple({0: batch} for _ in inputs),),
                dynamo=True,
                verbose=False,
            )
        except Exception as failed:  # what a user's own network may hold has no end
            error: BaseException = failed
            while error.__cause__ is not None:  # torch tells of its steps, and last of what failed
                error = error.__cause__
            line = printable(str(error).strip().partition("\n")[0])[:200]
            raise CheckpointError(
                f"variant {network.config.variant}: torch cannot export it as ONNX "
                f"({type(error).__name__}: {line})"
            ) from None
    settings = asdict(network.config)
    header = {"grid": asdict(grid), "network": settings, "about": about}
    model = program.model_proto
    model.metadata_props.append(onnx.StringStringEntryProto(key=HEADER, value=json.dumps(header)))
    content = model.SerializeToString()
    with reraise_as(CheckpointError, f"variant {network.config.variant}: ", of=CheckpointError):
        read_graph(content)
    write_result(path, content)
