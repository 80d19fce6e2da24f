"""Networks as ONNX files, for runtimes other than torch (`scenegen.model.runtime`)."""

import dataclasses
import json
import logging
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from lidarsim import GridSpec
from scenegen.errors import needs
from scenegen.files import write_whole
from scenegen.model.checkpoint import CheckpointError
from scenegen.model.network import FinalUp, Network, Output
from scenegen.model.runtime import HEADER, NAMES


class Traced(nn.Module):
    """A network whose output is a plain tuple, as tracing wants it, and whose heads are one where they read the same
    features: two convolutions in place of four, the second half zeros, take less time."""

    def __init__(self, network: Network):
        super().__init__()
        self.network = network
        shared = len(network.head) > 1 and "tudf" not in network.decoder
        self.heads = _joined(cast("list[FinalUp]", [*network.head.values()])) if shared else None

    def forward(self, *channels: Tensor) -> tuple[Tensor, ...]:
        """The network's inputs in their order, (B, X, Y, Z) each → its outputs, those of `NAMES`."""
        batch = dict(zip(self.network.config.inputs, channels, strict=True))
        if self.heads is None:
            output = self.network(batch)
        else:
            found = self.heads.each(self.network.features(batch)["shared"])
            output = Output.of(dict(zip(self.network.head, found, strict=True)))
        return tuple(part for part in (output.logits, output.tudf) if part is not None)


def _joined(heads: Sequence[FinalUp]) -> FinalUp:
    """One head that gives the fields of all: its filters are theirs, with zeros between what belongs to two."""
    states = [head.state_dict() for head in heads]
    state = {
        name: torch.cat([state[name] for state in states]) if values.ndim else values
        for name, values in states[0].items()
    }
    filters = torch.block_diag(*(state["split.weight"].flatten(1) for state in states))
    state["split.weight"] = filters.unflatten(1, (-1, 3, 3, 3))
    width, below = states[0]["refine.0.weight"].shape[:2]
    whole = FinalUp(below, width, len(heads))
    whole.load_state_dict(state)
    return whole


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
            Traced(network.cpu()).eval(),
            tuple(torch.zeros(2, *grid.shape) for _ in inputs),
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
