"""Is this machine fit? Versions, cores, disk, GPU, and a short self-test of the real thing."""

import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim.jit import cache_folder, cache_trouble
from scenegen.draw import draw_unit
from scenegen.recipe import preset
from scenegen.run.software import installed, software
from scenegen.run.workers import cores
from scenegen.source import DrawnWorlds

SELF_TEST_S = 2.0


def examine(folder: Path = Path()) -> dict[str, Any]:
    """Everything about this machine that matters here. `ok` is False where the self-test found a
    law broken."""
    usage = shutil.disk_usage(folder)
    test = self_test()
    return {
        "ok": test["ok"],
        "software": software(),
        "torch": installed("torch"),
        "gpu": _gpu(),
        "cores": cores(),
        "disk_free_gb": round(usage.free / 1e9, 1),
        "kernel_cache": cache_trouble("scenegen") or str(cache_folder("scenegen").parent),
        "self_test": test,
    }


def self_test() -> dict[str, Any]:
    """Draw samples for two seconds and hold them to their laws: every return lies in an occupied
    voxel, and a sample drawn again is the same to the bit."""
    recipe = preset("pillar")
    source = DrawnWorlds(recipe)
    first = draw_unit(
        source, recipe, seed=0, split="train", unit=0
    )  # compiles, where nothing is cached
    again = draw_unit(source, recipe, seed=0, split="train", unit=0)
    repeatable = [s.sha256() for s in first.samples] == [s.sha256() for s in again.samples]
    begin, units, samples, contained = time.perf_counter(), 0, 0, True
    while time.perf_counter() - begin < SELF_TEST_S:
        drawn = draw_unit(source, recipe, seed=0, split="train", unit=units)
        units, samples = units + 1, samples + len(drawn.samples)
        contained &= all(
            not np.any(sample.observed & ~sample.occupancy) for sample in drawn.samples
        )
    rate = samples / (time.perf_counter() - begin)
    return {
        "ok": repeatable and contained,
        "repeatable": repeatable,
        "returns_occupied": contained,
        "samples": samples,
        "samples_per_second_per_core": round(rate, 1),
    }


def _gpu() -> str:
    """Name of the GPU that torch sees, or why there is none."""
    if installed("torch") == "absent":
        return "unknown (torch is not installed)" if shutil.which("nvidia-smi") else "none"
    import torch

    return torch.cuda.get_device_name(0) if torch.cuda.is_available() else "none"
