"""Networks outside torch: ONNX files, and the CPU runtimes that run them faster than torch does."""

import dataclasses
import json
import logging
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from lidarsim import GridSpec
from model.checkpoint import CheckpointError, grid_from
from model.network import Network, NetworkConfig, Output
from scenegen.files import whole
from scenegen.world import one_line

if TYPE_CHECKING:
    from numpy.typing import NDArray

INPUT = "observed"
NAMES = {"occupancy": "logits", "tudf": "tudf"}
"""Outputs of an ONNX file, by task."""
HEADER = "scenegen"
"""Key of the file's metadata under which grid, variant and origin stand, as JSON."""
Runtime = Literal["openvino", "onnxruntime"]
RUNTIMES: tuple[Runtime, ...] = ("openvino", "onnxruntime")
"""Fastest first (docs/training.md)."""


class _Traced(nn.Module):
    """A network whose output is a plain tuple, as tracing wants it."""

    def __init__(self, network: Network):
        super().__init__()
        self.network = network

    def forward(self, observed: Tensor) -> tuple[Tensor, ...]:
        output = self.network(observed)
        return tuple(part for part in (output.logits, output.tudf) if part is not None)


def export_onnx(network: Network, grid: GridSpec, path: Path, *, about: dict[str, Any]) -> None:
    """Write `network` as ONNX: float32 ``observed`` (B, *grid.shape) → ``logits`` and/or ``tudf``, the same shape.

    Raises CheckpointError where onnx is not installed, DatasetError where the disk refuses.
    """
    try:
        import onnx
        import onnxscript  # noqa: F401 (torch's exporter imports it)
    except ImportError:
        raise CheckpointError(f"{path}: exporting needs onnx and onnxscript; pip install 'scenegen[export]'") from None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of torch's own code, and of the torchvision that is not there
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        program = torch.onnx.export(
            _Traced(network.cpu()).eval(),
            (torch.zeros(1, *grid.shape),),
            input_names=[INPUT],
            output_names=[name for task, name in NAMES.items() if task in network.config.tasks],
            dynamic_shapes=({0: torch.export.Dim("batch", min=1, max=4096)},),
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    header = {"grid": dataclasses.asdict(grid), "network": dataclasses.asdict(network.config), "about": about}
    model = program.model_proto
    model.metadata_props.append(onnx.StringStringEntryProto(key=HEADER, value=json.dumps(header)))
    with whole(path) as draft:
        draft.write_bytes(model.SerializeToString())


def load_onnx(
    path: Path, *, runtime: Runtime | None = None, threads: int = 0
) -> tuple[Callable[[Tensor], Output], GridSpec, dict[str, Any]]:
    """A function (B, *grid.shape) → `Output`, the grid, and what is said of the network; `threads` 0 for all cores.

    The fastest runtime that is installed runs it, unless `runtime` names one: OpenVINO computes in bfloat16 where the
    processor can, onnxruntime in float32. Raises CheckpointError for a file that `export_onnx` did not write.
    """
    header = _header(path)
    try:
        grid, known = grid_from(header), NetworkConfig(**header["network"]).tasks
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{path}: its header is damaged ({error}); export it again") from None
    tasks = [task for task in NAMES if task in known]
    run = _open(path, runtime, threads)

    def forward(observed: Tensor) -> Output:
        found = dict(zip(tasks, map(torch.from_numpy, run(observed.float().numpy(force=True))), strict=True))
        return Output(found.get("occupancy"), found.get("tudf"))

    return forward, grid, dict(header.get("about", {}))


def _open(path: Path, runtime: Runtime | None, threads: int) -> Callable[["NDArray[np.float32]"], Sequence[Any]]:
    for name in (runtime,) if runtime else RUNTIMES:
        try:
            return _openvino(path, threads) if name == "openvino" else _onnxruntime(path, threads)
        except ImportError:
            continue
        except Exception as error:  # each runtime has its own
            raise CheckpointError(f"{path}: {name} cannot run it: {one_line(error)}") from None
    raise CheckpointError(f"{path}: needs {' or '.join(RUNTIMES)}; pip install 'scenegen[export]'")


def _openvino(path: Path, threads: int) -> Callable[["NDArray[np.float32]"], Sequence[Any]]:
    import openvino

    hints = {"PERFORMANCE_HINT": "LATENCY"} | ({"INFERENCE_NUM_THREADS": threads} if threads else {})
    compiled = openvino.Core().compile_model(str(path), "CPU", hints)
    return lambda observed: [np.array(part) for part in compiled(observed).values()]


def _onnxruntime(path: Path, threads: int) -> Callable[["NDArray[np.float32]"], Sequence[Any]]:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    return lambda observed: session.run(None, {INPUT: observed})


def _header(path: Path) -> dict[str, Any]:
    try:
        import onnx
    except ImportError:
        raise CheckpointError(f"{path}: reading it needs onnx; pip install 'scenegen[export]'") from None
    try:
        model = onnx.load(str(path), load_external_data=False)
    except FileNotFoundError:
        raise CheckpointError(f"{path}: no such file; write one with `scenegen export`") from None
    except Exception as error:  # protobuf's errors share no base
        raise CheckpointError(f"{path}: is not an ONNX file ({one_line(error)})") from None
    for entry in model.metadata_props:
        if entry.key == HEADER:
            try:
                return dict(json.loads(entry.value))
            except (ValueError, TypeError) as error:
                raise CheckpointError(f"{path}: its header is damaged ({error}); export it again") from None
    raise CheckpointError(f"{path}: an ONNX file that is not from `scenegen export`; its grid is unknown")
