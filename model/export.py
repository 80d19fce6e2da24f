"""Networks as ONNX files, for the CPU runtimes that run them faster than torch does (`scenegen.model.runtime`)."""

import dataclasses
import json
import logging
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from lidarsim import GridSpec
from scenegen.errors import needs
from scenegen.files import write_whole
from scenegen.model.checkpoint import CheckpointError
from scenegen.model.network import Network
from scenegen.model.runtime import HEADER, NAMES


class _Traced(nn.Module):
    """A network whose output is a plain tuple, as tracing wants it."""

    def __init__(self, network: Network):
        super().__init__()
        self.network = network

    def forward(self, *channels: Tensor) -> tuple[Tensor, ...]:
        output = self.network(dict(zip(self.network.config.inputs, channels, strict=True)))
        return tuple(part for part in (output.logits, output.tudf) if part is not None)


def export_onnx(network: Network, grid: GridSpec, path: Path, *, about: dict[str, Any]) -> None:
    """Write `network` as ONNX: its inputs by name, float32 (B, *grid.shape) each → ``logits`` and/or ``tudf``, the same
    shape.

    Raises CheckpointError for a name that does not end in .onnx, and where onnx is not installed; DatasetError where
    the disk refuses.
    """
    if path.suffix != ".onnx":  # by its name it is read again, too
        raise CheckpointError(f"{path}: networks are exported as ONNX; give a name that ends in .onnx")
    try:
        import onnx
        import onnxscript  # noqa: F401 (torch's exporter imports it)
    except ImportError:
        raise CheckpointError(f"{path}: exporting {needs('onnx and onnxscript', 'export')}") from None
    inputs, batch = network.config.inputs, torch.export.Dim("batch", min=1, max=4096)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of torch's own code, and of the torchvision that is not there
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        program = torch.onnx.export(
            _Traced(network.cpu()).eval(),
            tuple(torch.zeros(1, *grid.shape) for _ in inputs),
            input_names=list(inputs),
            output_names=[name for task, name in NAMES.items() if task in network.config.tasks],
            dynamic_shapes=(tuple({0: batch} for _ in inputs),),
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    header = {"grid": dataclasses.asdict(grid), "network": dataclasses.asdict(network.config), "about": about}
    model = program.model_proto
    model.metadata_props.append(onnx.StringStringEntryProto(key=HEADER, value=json.dumps(header)))
    write_whole(path, model.SerializeToString())
