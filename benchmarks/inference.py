"""Inference on the CPU: milliseconds a map by variant and runtime, and against eager torch in
the same run.

    python benchmarks/inference.py      # all variants; compiling takes a minute each
    python benchmarks/inference.py --variant proposed --no-compile
"""

import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import measuring
import numpy as np
import torch
from measuring import Time
from torch import Tensor

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
Way = Callable[[dict[str, Tensor]], Any]
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
        file = Path(tempfile.mkdtemp(), "net.onnx")
        network = Network(NetworkConfig(variant=variant, inputs=inputs)).eval()
        ways = runners(network, file, given)
        if not given.no_compile:
            ways["compiled"] = torch.compile(ways["eager"])
        found = measure(ways, inputs, given.rounds)
        eager = found["eager"].wall
        cells = "  ".join(
            f"{name} {ms.wall:6.1f} ms ({ms.wall / eager:.2f}; {ms.processor:.1f})"
            for name, ms in found.items()
        )
        print(f"{variant:<9}:  {cells}", flush=True)
        for runtime in given.runtime:
            one_ms, two_ms = (
                side_by_side(processes, file, runtime, inputs, given.rounds) for processes in (1, 2)
            )
            print(f"  {runtime} by one thread {one_ms:.1f} ms, two processes {two_ms:.1f} ms")


def runners(network: Network, file: Path, options: Any) -> dict[str, Way]:
    """Ways to run `network`, by name; it is exported to `file`."""
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
    tasks = {name: partial(run, random_maps(inputs)) for name, run in ways.items()}
    return measuring.in_turn(tasks, rounds, burst=BURST)


def random_maps(inputs: tuple[str, ...]) -> dict[str, Tensor]:
    """A map of random voxels for each of the `inputs`."""
    noise = torch.Generator().manual_seed(0)
    return {name: (torch.rand(1, *GRID.shape, generator=noise) < 0.02).float() for name in inputs}


def side_by_side(processes: int, *words: Any) -> float:
    """Milliseconds a map in the slowest of so many processes that complete maps at the same time.
    `words` are those of `on_one_thread`."""
    with get_context("spawn").Pool(processes) as pool:
        return max(pool.starmap(on_one_thread, [words] * processes))


def on_one_thread(file: Path, runtime: str, inputs: tuple[str, ...], rounds: int) -> float:
    """Milliseconds a map in this process, which completes maps for half a second a round."""
    run, maps, took = load_onnx(file, runtime=runtime, threads=1)[0], random_maps(inputs), []
    end = time.perf_counter() + rounds / 2
    while (begin := time.perf_counter()) < end:
        run(maps)
        took.append(time.perf_counter() - begin)
    # the last half: processes that began first were alone for a while
    return 1e3 * float(np.median(took[len(took) // 2 :]))


if __name__ == "__main__":
    main()
