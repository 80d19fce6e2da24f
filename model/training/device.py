"""Device and precision of a network, and the processes of a training with several."""

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

MIN_CELLS = 32
"""Number of cells at the coarsest level from which on bfloat16 is sound on a CPU. Gradients were
wrong with 8 cells, and right with 18 (docs/log)."""


class TrainingError(ScenegenError):
    """Training cannot go on."""


def choose_device(name: str) -> torch.device:
    """Return the device called `name`, after trying it.

    Args:
        name: A device of torch. "auto" is a GPU if there is one, else the CPU. Under torchrun,
            "cuda" is the GPU of this process.

    Raises:
        TrainingError: if it cannot be used.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
        if device.type not in ("cpu", "cuda", "mps"):
            raise RuntimeError("no device to train on")  # "meta" would pass the trial below
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
    """Return the type in which a network computes.

    Args:
        precision: "auto" is bfloat16 if that is faster and sound, else float32.
        device: The device.
        shape: Shape of the maps, voxels.

    Returns:
        `torch.bfloat16` or `torch.float32`.
    """
    if precision == "auto":
        if device.type == "cuda":
            # emulated bfloat16 would be slower than float32
            faster = torch.cuda.is_bf16_supported(including_emulation=False)
        else:
            # over few cells, oneDNN's gradient of filters in bfloat16 depends on what its memory
            # held before, and can be NaN (docs/log)
            cells = math.prod(edge // 2**LEVELS for edge in shape)
            faster = cells >= MIN_CELLS and prefers_bfloat16()
        precision = "bfloat16" if faster else "float32"
    return torch.bfloat16 if precision == "bfloat16" else torch.float32


def autocast(device: torch.device, precision: torch.dtype) -> Any:
    """Return the context in which a network computes in a precision.

    Args:
        device: The device of the network.
        precision: See `resolve_precision`.

    Returns:
        A context manager; for float32, one that does nothing.
    """
    if precision == torch.float32:
        return nullcontext()
    return torch.autocast(device.type, dtype=precision)


def device_name(device: torch.device) -> str:
    """Name of a device for people; of a CPU, with the number of its threads."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"{processor()}, {torch.get_num_threads()} of {os.cpu_count()} threads"


class Group:
    """The processes of a torchrun, or this one alone. A context manager, which connects them.

    Args:
        device: Device of this process.
        precision: Type in which networks compute on it.
    """

    def __init__(self, device: torch.device, precision: torch.dtype = torch.float32) -> None:
        self.device, self.precision = device, precision
        # set by torchrun
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
        """Let the first process do something while the others wait.

        Args:
            action: A function without arguments.

        Raises:
            ScenegenError: in all processes, if `action` raises one in the first.
        """
        # were it raised in the first process only, the others would wait for it for ever
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
        """Copy the buffers of the first process's network to all others.

        On CPUs, each process normalises its own share of a batch, so statistics of batch norms
        differ; and a user's own network may have any buffers.
        """
        if self.size > 1:
            for buffer in network.buffers():
                dist.broadcast(buffer, 0)

    def any(self, mine: bool) -> bool:
        """Whether `mine` is true in any process."""
        return self.mean({"": float(mine)})[""] > 0

    def mean(self, mine: dict[str, float]) -> dict[str, float]:
        """Mean of all processes' numbers, by name. All must give the same names in one order."""
        if self.size == 1:
            return mine
        tensor = torch.tensor(list(mine.values()), dtype=torch.float64, device=self.device)
        dist.all_reduce(tensor)
        return dict(zip(mine, (tensor / self.size).tolist(), strict=True))

    def divisor(self, count: Tensor) -> Tensor:
        """Divisor of a process's sum, such that the mean of all processes' quotients is the mean
        over the elements of all.

        Gradients are averaged over processes. If each divided by its own count, elements of a
        process with few would weigh more.

        Args:
            count: Number of elements of this process, a scalar.

        Returns:
            Number of elements of all processes, at least 1, divided by the number of processes.
        """
        if self.size == 1:
            return local_divisor(count)
        dist.all_reduce(total := count.clone())
        return local_divisor(total) / self.size

    def gather(self, mine: Any) -> list[Any]:
        """Collect a value from every process, in the order of their ranks."""
        gathered = [mine] * self.size
        if self.size > 1:
            dist.all_gather_object(gathered, mine)
        return gathered
