"""Networks as ONNX files, for runtimes other than torch (`scenegen.model.runtime`)."""

import dataclasses
import json
import logging
import warnings
from contextlib import redirect_stderr
from io import StringIO
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from lidarsim import GridSpec
from scenegen.errors import needs, printable
from scenegen.files import Json, check_ours, write_result
from scenegen.model.checkpoint import CheckpointError
from scenegen.model.network import FinalUp, Network, Output
from scenegen.model.runtime import HEADER, NAMES


class Traced(nn.Module):
    """A network whose output is a plain tuple, as tracing wants it, and whose heads are one where
    they read the same features: two convolutions in place of four, the second half zeros, take less
    time."""

    def __init__(self, network: Any):
        super().__init__()
        self.network = network
        shared = isinstance(network, Network) and len(network.head) > 1
        self.heads = _joined(network) if shared and "tudf" not in network.decoder else None

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """The network's inputs in their order, (B, X, Y, Z) each → its outputs, those of
        `NAMES`."""
        batch = dict(zip(self.network.config.inputs, inputs, strict=True))
        if self.heads is None:
            output = Output(*self.network(batch))
        else:
            found = self.heads.each(self.network.features(batch)["shared"])
            output = Output.of(dict(zip(self.network.head, found, strict=True)))
        return tuple(part for part in output if part is not None)


def _joined(network: Network) -> FinalUp:
    """One head that gives the fields of all: its filters are theirs, with zeros between what
    belongs to two."""
    states = [head.state_dict() for head in network.head.values()]
    state = {
        name: torch.cat([one[name] for one in states]) if values.ndim else values
        for name, values in states[0].items()
    }
    filters = torch.block_diag(*(one["split.weight"].flatten(1) for one in states))
    state["split.weight"] = filters.unflatten(1, (-1, 3, 3, 3))
    width, below = states[0]["refine.0.weight"].shape[:2]
    whole = FinalUp(below, width, len(states))
    whole.load_state_dict(state)
    return whole


def export_onnx(network: Any, grid: GridSpec, path: Path, *, about: Json) -> None:
    """Write `network` as ONNX: its inputs by name, float32 (B, *grid.shape) each → ``logits``
    and/or ``tudf``, the same shape.

    Raises CheckpointError for a name that does not end in .onnx, where onnx is not installed, and
    for a network that torch cannot export; DatasetError where the disk refuses.
    """
    if path.suffix != ".onnx":  # by its name it is read again, too
        raise CheckpointError(
            f"{path}: networks are exported as ONNX; give a name that ends in .onnx"
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
                output_names=[name for task, name in NAMES.items() if task in network.tasks],
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
    settings = dataclasses.asdict(network.config)
    header = {"grid": dataclasses.asdict(grid), "network": settings, "about": about}
    model = program.model_proto
    model.metadata_props.append(onnx.StringStringEntryProto(key=HEADER, value=json.dumps(header)))
    write_result(path, model.SerializeToString())
