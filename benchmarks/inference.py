"""Inference on the CPU: milliseconds a map by variant, stem and runtime, and against eager torch in
the same run.

    python benchmarks/inference.py      # all variants, both stems; compiling takes a minute each
    python benchmarks/inference.py --variant proposed --stem-stride 2 --no-compile
"""

import tempfile
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import measuring
import torch
from measuring import Time

from lidarsim import GridSpec
from scenegen.model.config import VARIANTS, NetworkConfig
from scenegen.model.network import Network, placed
from scenegen.model.onnx import RUNTIMES, Runtime, export_onnx, load_onnx
from scenegen.model.training.device import autocast, resolve_precision

INPUTS = {"columns": ("observed", "free")}
"""What a variant is shown, where it is not `observed` alone: as the bundled one."""
BURST = 4
"""Maps that a way completes in a row; the first is not timed, for threads of the way before it
still wait for work."""
GRID = GridSpec()
Way = Callable[[dict[str, torch.Tensor]], Any]
"""A network by some runtime: what it gives for maps by name."""


def main() -> None:
    """Print one table."""
    parser = measuring.options(__doc__)
    parser.add_argument("--variant", nargs="*", choices=VARIANTS, default=VARIANTS)
    parser.add_argument("--stem-stride", nargs="*", type=int, choices=(2, 1), default=(2, 1))
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--no-compile", action="store_true")
    parser.add_argument("--runtime", nargs="*", choices=RUNTIMES, default=RUNTIMES)
    parser.add_argument("--rounds", type=int, default=10)
    options = measuring.parse(
        parser, variant=["occ"], stem_stride=[2], runtime=["openvino"], rounds=1, no_compile=True
    )
    torch.set_num_threads(options.threads)
    print(
        f"{options.threads} threads, one map of {GRID.shape}, median of {options.rounds} bursts "
        f"in turn;"
    )
    print("milliseconds by the clock, ratio to eager, milliseconds of processor time")
    for stride in options.stem_stride:
        for variant in options.variant:
            network = Network(
                NetworkConfig(
                    variant=variant, inputs=INPUTS.get(variant, ("observed",)), stem_stride=stride
                )
            ).eval()
            ways = runners(
                network, options.threads, options.runtime, compiled=not options.no_compile
            )
            found = measure(ways, network.config.inputs, options.rounds)
            eager = found["eager"].wall
            cells = "  ".join(
                f"{name} {ms.wall:6.1f} ms ({ms.wall / eager:.2f}; {ms.processor:.1f})"
                for name, ms in found.items()
            )
            print(f"{variant:<9} stem {stride}:  {cells}", flush=True)


def runners(
    network: Network, threads: int, runtimes: Iterable[Runtime], *, compiled: bool
) -> dict[str, Way]:
    """Every way to run `network`, by name."""
    folder = Path(tempfile.mkdtemp())
    export_onnx(network, GRID, folder / "net.onnx", about={})
    placed(network, "cpu")
    device = torch.device("cpu")
    ways: dict[str, Way] = {"eager": network}
    if resolve_precision("auto", device) == torch.bfloat16:

        def in_bfloat16(maps: dict[str, torch.Tensor]) -> Any:
            with autocast(device, torch.bfloat16):
                return network(maps)

        ways["eager bf16"] = in_bfloat16
    if compiled:
        ways["compiled"] = torch.compile(network)
    for runtime in runtimes:
        ways[runtime] = load_onnx(folder / "net.onnx", runtime=runtime, threads=threads)[0]
    return ways


@torch.inference_mode()
def measure(ways: dict[str, Way], inputs: tuple[str, ...], rounds: int) -> dict[str, Time]:
    """Medians of each for one map of the `inputs`; the ways take turns, so that all meet the same
    machine."""
    noise = torch.Generator().manual_seed(0)
    maps = {name: (torch.rand(1, *GRID.shape, generator=noise) < 0.02).float() for name in inputs}
    for run in ways.values():
        run(maps)
    times: dict[str, list[Time]] = {name: [] for name in ways}
    for _ in range(rounds):
        for name, run in ways.items():
            run(maps)
            times[name] += [measuring.timed(partial(run, maps)) for _ in range(BURST - 1)]
    return {name: measuring.median(found) for name, found in times.items()}


if __name__ == "__main__":
    main()
