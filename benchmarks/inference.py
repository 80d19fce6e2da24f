"""Inference on the CPU: milliseconds a map by variant and runtime, and against eager torch in
the same run.

    python benchmarks/inference.py      # all variants; compiling takes a minute each
    python benchmarks/inference.py --variant proposed --no-compile
"""

import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import measuring
import torch
from measuring import Time

from lidarsim import GridSpec
from scenegen.model.config import VARIANTS, NetworkConfig
from scenegen.model.network import Network, placed
from scenegen.model.onnx import RUNTIMES, export_onnx, load_onnx
from scenegen.model.training.device import resolve_precision

INPUTS = {"columns": ("observed", "free")}
"""What a variant is shown, where it is not `observed` alone: as the bundled one."""
BURST = 4
"""Maps that a way completes in a row."""
GRID = GridSpec()
Way = Callable[[dict[str, torch.Tensor]], Any]
"""A network by some runtime: what it gives for maps by name."""


class Options(measuring.Options):
    """What is measured."""

    variant: Sequence[str] = tuple(VARIANTS)
    threads: int = torch.get_num_threads()
    no_compile: bool = False
    runtime: Sequence[str] = RUNTIMES
    rounds: int = 10


def main() -> None:
    """Print one table."""
    given = measuring.parse(
        Options,
        variant=["occ"],
        runtime=["openvino"],
        rounds=1,
        no_compile=True,
    )
    torch.set_num_threads(given.threads)
    print(
        f"{given.threads} threads, one map of {GRID.shape}, median of {given.rounds} bursts "
        f"in turn;"
    )
    print("milliseconds by the clock, ratio to eager, milliseconds of processor time")
    for variant in given.variant:
        inputs = INPUTS.get(variant, ("observed",))
        ways = runners(Network(NetworkConfig(variant=variant, inputs=inputs)).eval(), given)
        if not given.no_compile:
            ways["compiled"] = torch.compile(ways["eager"])
        found = measure(ways, inputs, given.rounds)
        eager = found["eager"].wall
        cells = "  ".join(
            f"{name} {ms.wall:6.1f} ms ({ms.wall / eager:.2f}; {ms.processor:.1f})"
            for name, ms in found.items()
        )
        print(f"{variant:<9}:  {cells}", flush=True)


def runners(network: Network, options: Any) -> dict[str, Way]:
    """Ways to run `network`, by name."""
    file = Path(tempfile.mkdtemp(), "net.onnx")
    export_onnx(network, GRID, file, metadata={})
    placed(network, "cpu")
    ways: dict[str, Way] = {"eager": network}
    if resolve_precision("auto", torch.device("cpu")) == torch.bfloat16:
        ways["eager bf16"] = torch.autocast("cpu", torch.bfloat16)(network)
    for runtime in options.runtime:
        ways[runtime] = load_onnx(file, runtime=runtime, threads=options.threads)[0]
    return ways


@torch.inference_mode()
def measure(ways: dict[str, Way], inputs: tuple[str, ...], rounds: int) -> dict[str, Time]:
    """Medians of each for one map of the `inputs`."""
    noise = torch.Generator().manual_seed(0)
    maps = {name: (torch.rand(1, *GRID.shape, generator=noise) < 0.02).float() for name in inputs}
    tasks = {name: partial(run, maps) for name, run in ways.items()}
    return measuring.in_turn(tasks, rounds, burst=BURST)


if __name__ == "__main__":
    main()
