"""Inference on the CPU: milliseconds a map by variant, stem and runtime, and against eager torch in the same run.

python benchmarks/inference.py                          # all variants, both stems; compiling takes a minute each
python benchmarks/inference.py --variant proposed --stem-stride 2 --no-compile --plot docs/pictures/runtimes.png
"""

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from bars import draw

from lidarsim import GridSpec
from scenegen.model.config import VARIANTS, NetworkConfig
from scenegen.model.export import export_onnx
from scenegen.model.network import Network
from scenegen.model.runtime import RUNTIMES, load_onnx
from scenegen.model.training.device import autocast, resolve_precision

INPUTS = {"columns": ("observed", "free")}
"""What a variant is shown, where it is not `observed` alone: as the bundled one."""
ROUNDS = 10
BURST = 4
"""Maps that a way completes in a row; the first is not timed, for threads of the way before it still wait for work."""
GRID = GridSpec()


def main() -> None:
    """Print one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--variant", nargs="*", choices=VARIANTS, default=VARIANTS)
    parser.add_argument("--stem-stride", nargs="*", type=int, choices=(2, 1), default=(2, 1))
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--no-compile", action="store_true")
    parser.add_argument("--plot", type=Path, help="a picture of the table, PNG")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    print(f"{options.threads} threads, one map of {GRID.shape}, median of {ROUNDS} bursts in turn; (ratio to eager)")
    rows = {}
    for stride in options.stem_stride:
        for variant in options.variant:
            network = Network(
                NetworkConfig(variant=variant, inputs=INPUTS.get(variant, ("observed",)), stem_stride=stride)
            ).eval()
            found = measure(runners(network, options.threads, compiled=not options.no_compile), network.config.inputs)
            rows[f"{variant}, stem {stride}"] = found
            cells = "  ".join(f"{name} {ms:6.1f} ms ({ms / found['eager']:.2f})" for name, ms in found.items())
            print(f"{variant:<9} stem {stride}:  {cells}", flush=True)
    if options.plot:
        draw(options.plot, rows, f"One map of {GRID.shape}, {options.threads} threads", stacked=False)


def runners(network: Network, threads: int, *, compiled: bool) -> dict[str, Callable[[dict[str, torch.Tensor]], Any]]:
    """Every way to run `network`, by name."""
    folder = Path(tempfile.mkdtemp())
    export_onnx(network, GRID, folder / "net.onnx", about={})
    network.placed("cpu")
    device = torch.device("cpu")
    ways: dict[str, Callable[[dict[str, torch.Tensor]], Any]] = {"eager": network}
    if resolve_precision("auto", device) == torch.bfloat16:

        def in_bfloat16(maps: dict[str, torch.Tensor]) -> Any:
            with autocast(device, torch.bfloat16):
                return network(maps)

        ways["eager bf16"] = in_bfloat16
    if compiled:
        ways["compiled"] = torch.compile(network)
    for runtime in RUNTIMES:
        ways[runtime] = load_onnx(folder / "net.onnx", runtime=runtime, threads=threads)[0]
    return ways


@torch.inference_mode()
def measure(ways: dict[str, Callable[[dict[str, torch.Tensor]], Any]], inputs: tuple[str, ...]) -> dict[str, float]:
    """Median milliseconds of each for one map of the `inputs`; the ways take turns, so that all meet the same
    machine."""
    noise = torch.Generator().manual_seed(0)
    maps = {name: (torch.rand(1, *GRID.shape, generator=noise) < 0.02).float() for name in inputs}
    for run in ways.values():
        run(maps)
    times: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(ROUNDS):
        for name, run in ways.items():
            run(maps)
            for _ in range(BURST - 1):
                begin = time.perf_counter()
                run(maps)
                times[name].append((time.perf_counter() - begin) * 1e3)
    return {name: statistics.median(values) for name, values in times.items()}


if __name__ == "__main__":
    main()
