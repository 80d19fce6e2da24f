"""Networks as ONNX files: export, and completion by a CPU runtime.

Files are first examined in processes with limits on time and memory, because a stranger's file can
make a parser or a runtime crash, hang or exhaust memory. OpenVINO is faster than torch.
"""

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
"""Names of an ONNX file's outputs, by task. Outputs of other targets have their `target_name`."""
HEADER = "scenegen"
"""Key of the entry in a file's metadata that holds grid, settings and metadata of the network, as
JSON."""
LOOPS = frozenset({"If", "Loop", "Scan", "SequenceMap"})
"""Operations whose work can depend on the map, so that a trial on an empty map proves nothing. No
export has any."""
BYTES_A_FEATURE = 100
"""Memory that a runtime takes for two maps, at most: bytes per voxel and channel of the first
level."""
RUNTIMES = ("openvino", "onnxruntime")
"""Runtimes, fastest first (docs/complete.md)."""
Run = Callable[[Mapping[str, Field]], Sequence[Any]]
"""Runs a file: a named batch, (B, *grid.shape) float32 each, to the outputs in their order."""


def load_onnx(
    path: Path, *, runtime: str | None = None, threads: int = 0, trusted: Collection[str] = ()
) -> tuple[Callable[[Batch], Output], "Examined"]:
    """Open an ONNX file that `export_onnx` wrote.

    Two processes with limits examine each content once: one reads the file, one completes an empty
    map. That takes a second with OpenVINO, and half a second with onnxruntime. OpenVINO computes in
    bfloat16 if that is faster (`prefers_bfloat16`), onnxruntime in float32.

    Args:
        path: The file.
        runtime: One of `RUNTIMES`; by default, the fastest that is installed.
        threads: Threads of the processor; 0 for all cores.
        trusted: Own code that may be imported, each as ``module:Object``.

    Returns:
        A function from a named batch, (B, *grid.shape) each, to its `Output`; and the description
        of the file.

    Raises:
        CheckpointError: if `export_onnx` did not write the file, if weights or outputs are not
            finite, if no installed runtime runs it within the limits, or if it needs own code that
            is not in `trusted`.
    """
    content = read_bounded(path, MAX_WEIGHTS_BYTES)
    with reraise_as(CheckpointError, f"{path}: ", of=CheckpointError):
        file = _examined(content, runtime)
    # the variant's code is in the graph; inputs and targets are still computed by Python
    check_own(path, trusted, *file.config.inputs, *file.config.targets)
    run = _open(content, file, threads)

    def forward(batch: Batch) -> Output:
        values = run({name: batch[name].float().numpy(force=True) for name in file.config.inputs})
        by_name = dict(zip(file.outputs, map(torch.from_numpy, values), strict=True))
        logits, tudf = (by_name.pop(name, None) for name in NAMES.values())
        return Output(logits, tudf, by_name)

    return forward, file


@dataclass(frozen=True)
class Examined:
    """Description of an ONNX file that may be opened in this process."""

    runtime: str
    """One of `RUNTIMES`."""
    config: NetworkConfig
    grid: GridSpec
    metadata: Json
    """See `scenegen.model.checkpoint.save_network`."""
    outputs: tuple[str, ...]
    """Names of the file's outputs, in the order of an `Output`."""


@cache  # worker processes that are forked from here inherit the result
def _examined(content: bytes, runtime: str | None) -> Examined:
    if find_spec("onnx") is None:
        raise CheckpointError(needs("onnx", "export"))
    usable = [name for name in ((runtime,) if runtime else RUNTIMES) if find_spec(name) is not None]
    if not usable:
        raise CheckpointError(needs(runtime or " or ".join(RUNTIMES), "export"))
    memory = GUARD_BYTES + 4 * len(content)  # for the parsed model and copies of its weights
    try:
        graph = guarded(read_graph, content, seconds=GUARD_S, memory_bytes=memory)
    except GuardError as error:
        raise CheckpointError(f"is not an ONNX file that can be read ({error})") from None
    file = Examined(usable[0], *graph)
    # the first level dominates: each further one has an eighth of the voxels, twice the channels
    features = file.config.width * int(np.prod(file.grid.shape))
    memory += BYTES_A_FEATURE * features
    try:
        guarded(_try, (content, file), seconds=GUARD_S + features / 1e6, memory_bytes=memory)
    except GuardError as error:
        raise CheckpointError(f"{usable[0]} cannot run it: {error}; export it again") from None
    return file


def read_graph(content: bytes) -> tuple[NetworkConfig, GridSpec, Json, tuple[str, ...]]:
    """Parse an ONNX file and check its graph. Called in a process with limits.

    Args:
        content: Bytes of the file.

    Returns:
        Settings, grid, metadata, and names of the outputs.

    Raises:
        CheckpointError: if `export_onnx` did not write the file, if it has loops, sparse tensors or
            data in other files, if weights are not finite, or if inputs and outputs are not those
            of the header. Errors of `onnx` pass through.
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
        (config, grid), metadata = network_from(header), dict(header.get("about", {}))
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise CheckpointError(
            f"its header is damaged ({printable(error)[:200]}); export it again"
        ) from None
    graph = model.graph
    attributes = [attribute for node in graph.node for attribute in node.attribute]
    tensors = [
        *graph.initializer,
        *(attribute.t for attribute in attributes),
        *(tensor for attribute in attributes for tensor in attribute.tensors),
    ]
    # a domain marks operations that are not ONNX's own, which only some runtimes have
    odd = sorted({node.op_type for node in graph.node if node.op_type in LOOPS or node.domain})
    # external data may be any file of the disk
    external = any(tensor.data_location for tensor in tensors)
    # their values are not among `tensors`, so they would escape the check for NaN
    sparse = graph.sparse_initializer or any(
        attribute.HasField("sparse_tensor") or attribute.sparse_tensors for attribute in attributes
    )
    if odd or model.functions or external or sparse:
        raise CheckpointError(
            "has loops, sparse tensors or parts elsewhere, which no export has "
            f"({printable(odd)[:100]})"
        )
    inputs = [value.name for value in graph.input]
    if sorted(inputs) != sorted(config.inputs):
        raise CheckpointError(
            f"takes {printable(', '.join(inputs))[:100] or 'nothing'}, where its header says "
            f"{', '.join(config.inputs)}; export it again"
        )
    _check_numbers(graph, tensors)
    outputs = {output.name for output in graph.output}
    further = [*map(target_name, config.targets)]
    tasks = [task for task in (*NAMES, *further) if NAMES.get(task, task) in outputs]
    variant = VARIANTS.get(config.variant)  # None for a user's own, whose tasks are unknown here
    expected = {*(variant.tasks if variant else tasks), *further}
    if set(tasks) != expected:
        raise CheckpointError(
            f"gives {' and '.join(tasks) or 'nothing'}, where {config.variant} gives "
            f"{' and '.join(sorted(expected))}; export it again"
        )
    return config, grid, metadata, tuple(NAMES.get(task, task) for task in tasks)


def _check_numbers(graph: Any, tensors: Sequence[Any]) -> None:
    """Raise CheckpointError if a number of a graph is not finite. A scalar may be infinite, since
    it is a constant of code and no weight."""
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
        if any(np.isnan([value.f, *value.floats]).any() for value in node.attribute):
            raise CheckpointError(
                f"{printable(node.name)[:100]} has an attribute that is NaN; export it again"
            )


def _try(task: tuple[bytes, Examined]) -> None:
    """Complete two empty maps. Raises CheckpointError if the outputs are not completions; errors of
    the runtime pass through."""
    content, file = task
    shape = (2, *file.grid.shape)  # with one map, a file with a fixed batch of one would pass
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


def _open(content: bytes, file: Examined, threads: int) -> Run:
    if file.runtime == "onnxruntime":
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 4  # fatal only: errors are raised, and would show twice
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        return lambda batch: session.run(list(file.outputs), dict(batch))
    # its telemetry looks up a host on every import and writes to the home folder (docs/log)
    sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]
    import openvino

    hints = {
        "PERFORMANCE_HINT": "LATENCY",
        "INFERENCE_PRECISION_HINT": "bf16" if prefers_bfloat16() else "f32",
        "INFERENCE_NUM_THREADS": threads,
        # processes that infer on one thread each would all be pinned to the first core
        "ENABLE_CPU_PINNING": threads != 1,
    }
    core = openvino.Core()

    @cache
    def compiled(single: bool) -> Any:
        """Compile the network for any number of maps or, which is faster, for a `single` one."""
        model = core.read_model(content, b"")
        if single:
            model.reshape(dict.fromkeys(model.inputs, (1, *file.grid.shape)))
        return core.compile_model(model, "CPU", hints)

    # a compiled network keeps the values of its last run, which another thread would overwrite
    lock = Lock()

    def run(batch: Mapping[str, Field]) -> Sequence[Any]:
        with lock:
            network = compiled(len(next(iter(batch.values()))) == 1)
            # OpenVINO has dropped inputs that the network does not use
            values = network([batch[port.any_name] for port in network.inputs])
            # copies, since the next run overwrites the values
            return [np.array(values[name]) for name in file.outputs]

    compiled(True)  # compile now, so that the first map does not wait
    return run


class Traced(nn.Module):
    """A network whose inputs and outputs are plain tensors in order, as torch's exporter needs."""

    def __init__(self, network: Any):
        super().__init__()
        self.network = network

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Run the network.

        Args:
            inputs: Its inputs in the order of its `config`, (B, X, Y, Z) each.

        Returns:
            Its outputs, in the order of an `Output`.
        """
        # a network may return a plain tuple
        output = self.network(dict(zip(self.network.config.inputs, inputs, strict=True)))
        return tuple(Output(*output).by_target.values())


def export_onnx(network: Any, grid: GridSpec, path: Path, *, metadata: Json) -> None:
    """Write a network as ONNX.

    The graph takes the network's inputs by name, (B, *grid.shape) float32 each. It gives ``logits``
    and ``tudf``, as far as the network predicts them, of the same shape, and other targets by their
    `target_name`.

    Args:
        network: The network. It is moved to the CPU.
        grid: Grid of the maps that it completes.
        path: The file; its name ends in .onnx.
        metadata: Metadata of the network, which the file keeps.

    Raises:
        CheckpointError: if the name does not end in .onnx, if onnx is not installed, or if torch
            cannot export the network.
        DatasetError: if the disk refuses.
    """
    if path.suffix != ".onnx":  # `Completer.from_pretrained` recognises ONNX files by this suffix
        raise CheckpointError(
            f"{path}: networks are exported as ONNX; give a name that ends in .onnx"
        )
    if getattr(network, "draws", False):  # a runtime's random numbers have no seed
        raise CheckpointError(
            f"variant {network.config.variant}: draws its answers; only networks that do not are "
            "exported"
        )
    check_ours(path)  # refused before the export, which takes seconds
    try:
        import onnx
        import onnxscript  # noqa: F401 (torch's exporter imports it)
    except ImportError:
        needed = needs("onnx and onnxscript", "export")
        raise CheckpointError(f"{path}: exporting {needed}") from None
    inputs, batch = network.config.inputs, torch.export.Dim("batch", min=1, max=4096)
    # torch prints its progress and failures; the error below says the same in one line
    with warnings.catch_warnings(), redirect_stderr(StringIO()):
        warnings.simplefilter("ignore")  # on torch's own code, and on the absence of torchvision
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        try:
            program: Any = torch.onnx.export(
                Traced(network.cpu()).eval(),
                # two maps: the exporter would fix a size of one
                tuple(torch.zeros(2, *grid.shape) for _ in inputs),
                input_names=list(inputs),
                output_names=[NAMES.get(name, name) for name in network.targets],
                dynamic_shapes=(tuple({0: batch} for _ in inputs),),
                dynamo=True,
                verbose=False,
            )
        except Exception as failed:  # a user's own network may raise anything
            error: BaseException = failed
            while error.__cause__ is not None:  # torch wraps the failure in errors of its stages
                error = error.__cause__
            line = printable(str(error).strip().partition("\n")[0])[:200]
            raise CheckpointError(
                f"variant {network.config.variant}: torch cannot export it as ONNX "
                f"({type(error).__name__}: {line})"
            ) from None
    settings = asdict(network.config)
    header = {"grid": asdict(grid), "network": settings, "about": metadata}
    model = program.model_proto
    model.metadata_props.append(onnx.StringStringEntryProto(key=HEADER, value=json.dumps(header)))
    content = model.SerializeToString()
    # a file that could not be opened again, such as one with loops, is not written
    with reraise_as(CheckpointError, f"variant {network.config.variant}: ", of=CheckpointError):
        read_graph(content)
    write_result(path, content)
