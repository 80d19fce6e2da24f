"""Where a network computes, in which precision, and together with which other processes."""

import math
import os
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn

from lidarsim import GridSpec
from scenegen.base.errors import ScenegenError
from scenegen.base.executors import processor
from scenegen.model.config import LEVELS
from scenegen.model.losses import local_divisor
from scenegen.model.network import prefers_bfloat16

FEWEST_CELLS = 32
"""Cells of the coarsest level from which bfloat16 is sound on a CPU: 8 are not, 18 are."""


class TrainingError(ScenegenError):
    """Training cannot go on."""


def choose_device(name: str) -> torch.device:
    """The device called `name`; ``auto`` is a GPU where there is one, this process's own under
    torchrun.

    Raises TrainingError for a device that is not here.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
        if device.type not in ("cpu", "cuda", "mps"):
            raise RuntimeError("no device to train on")
        if device.type == "cuda" and device.index is None:
            device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0)))
        torch.zeros(1, device=device)
        if device.type == "cuda":
            torch.cuda.set_device(device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise TrainingError(
            f"--device {name}: cannot be used here ({reason}); give cpu, or cuda where there is one"
        ) from None
    return device


def resolve_precision(
    precision: str, device: torch.device, shape: tuple[int, ...] = GridSpec().shape
) -> torch.dtype:
    """The type that `precision` means on `device`, for maps of `shape`.

    "auto" is bfloat16 where that is faster. On a CPU it is float32 for maps whose coarsest level
    has but a few cells, too: there oneDNN's gradient of a convolution's filters in bfloat16 depends
    on what its memory held before (docs/log).
    """
    if precision == "auto":
        if device.type == "cuda":
            faster = torch.cuda.is_bf16_supported(including_emulation=False)
        else:
            cells = math.prod(edge // 2**LEVELS for edge in shape)
            faster = cells >= FEWEST_CELLS and prefers_bfloat16()
        precision = "bfloat16" if faster else "float32"
    return torch.bfloat16 if precision == "bfloat16" else torch.float32


def autocast(device: torch.device, precision: torch.dtype) -> Any:
    """Where the network computes in `precision`."""
    if precision == torch.float32:
        return nullcontext()
    return torch.autocast(device.type, dtype=precision)


def device_name(device: torch.device) -> str:
    """What a device is called."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"{processor()}, {torch.get_num_threads()} of {os.cpu_count()} threads"


class Group:
    """The processes of a torchrun, or this one alone: the `device` of this one, and the `precision`
    in which networks compute there."""

    def __init__(self, device: torch.device, precision: torch.dtype = torch.float32) -> None:
        self.device, self.precision = device, precision
        self.size = int(os.environ.get("WORLD_SIZE", 1))
        self.rank = int(os.environ.get("RANK", 0))
        self.first = self.rank == 0
        """Whether this process writes files."""

    def __enter__(self) -> "Group":
        if self.size > 1:
            on_gpu = self.device.type == "cuda"
            dist.init_process_group(
                "nccl" if on_gpu else "gloo", device_id=self.device if on_gpu else None
            )
        return self

    def __exit__(self, *error: object) -> None:
        if self.size > 1:
            dist.destroy_process_group()

    def first_alone(self, action: Callable[[], None]) -> None:
        """Let the first process do something while the others wait; what it raises, all raise."""
        problem: ScenegenError | None = None
        if self.first:
            try:
                action()
            except ScenegenError as error:
                problem = error
        problem = self.gather(problem)[0]
        if problem is not None:
            raise problem

    def share_statistics(self, network: nn.Module) -> None:
        """Give every process the first one's buffers: a user's own network may have some that each
        updates by itself."""
        if self.size > 1:
            for buffer in network.buffers():
                dist.broadcast(buffer, 0)

    def any(self, mine: bool) -> bool:
        """Whether any process says so."""
        return self.mean({"": float(mine)})[""] > 0

    def mean(self, mine: dict[str, float]) -> dict[str, float]:
        """Mean of all processes' numbers, by name; all give the same names."""
        if self.size == 1:
            return mine
        tensor = torch.tensor(list(mine.values()), dtype=torch.float64, device=self.device)
        dist.all_reduce(tensor)
        return dict(zip(mine, (tensor / self.size).tolist(), strict=True))

    def divisor(self, count: Tensor) -> Tensor:
        """What each process divides a sum over its `count` things by, so that the mean of all
        processes' quotients is the mean over all things: 1 at least, shared among the processes."""
        if self.size == 1:
            return local_divisor(count)
        dist.all_reduce(total := count.clone())
        return local_divisor(total) / self.size

    def gather(self, mine: Any) -> list[Any]:
        """What every process gives, in order."""
        gathered = [mine] * self.size
        if self.size > 1:
            dist.all_gather_object(gathered, mine)
        return gathered
