"""`scenegen doctor` and `scenegen completion`: whether this machine is fit, and what makes its
shell complete the command line."""

import json
import re
import shutil
import time
from contextlib import suppress
from typing import Any

import rich_click as click
from click.shell_completion import get_completion_class

from scenegen.cli.options import command, json_option
from scenegen.cli.show import announce_compilation, flat, say, show_table
from scenegen.cli.types import Choice
from scenegen.errors import ScenegenError, needs
from scenegen.files import Json

LITTLE_GB = 5.0
"""Free disk below which `doctor` warns: a dataset of default size takes a quarter of a gigabyte, a
run some more."""
SELF_TEST_S = 2.0
GENERATED = 3250
"""Samples that `generate` makes by default, of all splits together."""


@command("doctor", "doctor --json")
@json_option
def doctor(as_json: bool) -> None:
    """Check this machine: versions, extras, cores, disk, GPU, cache, pace, and a two-second
    self-test."""
    if not as_json:
        announce_compilation()
    found = examine()
    if as_json:
        print(json.dumps(found))
    else:
        rows, advice = flat(found), _advice(found)
        marks = dict.fromkeys(rows, ("✓", "green")) | dict.fromkeys(advice, ("!", "yellow"))
        marks |= {name: ("✗", "red") for name, value in rows.items() if value is False}
        told = {name: f"{value}{advice.get(name, '')}" for name, value in rows.items()}
        show_table(told, marks=marks)
    if not found["ok"]:
        raise ScenegenError(
            "the self-test failed: samples made here cannot be trusted; reinstall, then run it "
            "again"
        )
    if not as_json:
        say("all is well")


def _advice(found: Json) -> dict[str, str]:
    """What to do about what is missing, by the name of its line."""
    from lidarsim.jit import cache_trouble

    advice = {f"extras.{name}": "" for name, told in found["extras"].items() if told != "ok"}
    if found["torch"] == "absent":
        advice["torch"] = f"; training a network and completing with one {needs('torch', 'train')}"
    if found["disk_free_gb"] < LITTLE_GB:
        advice["disk_free_gb"] = (
            f"; less than {LITTLE_GB:g} GB: free some before generating or training"
        )
    if cache_trouble("scenegen"):
        advice["kernel_cache"] = (
            "; kernels compile in every run: set SCENEGEN_CACHE to a folder that only you can write"
        )
    return advice


def examine() -> Json:
    """Everything about this machine that matters here. `ok` is False where the self-test found a
    law broken; the free disk is that of the working folder."""
    from lidarsim.jit import cache_folder, cache_trouble
    from scenegen.run import cores
    from scenegen.run.software import installed, software

    test = self_test()
    return {
        "ok": test["ok"],
        "software": software(),
        "torch": installed("torch"),
        "extras": extras(),
        "gpu": _gpu(),
        "cores": cores(),
        "disk_free_gb": round(shutil.disk_usage(".").free / 1e9, 1),
        "kernel_cache": cache_trouble("scenegen") or str(cache_folder("scenegen").parent),
        "self_test": test,
        "generate_2500_s": round(GENERATED / (test["samples_per_second_per_core"] * cores()), 1),
    }


def extras() -> dict[str, str]:
    """Of every extra, "ok", or what it lacks here."""
    from importlib.metadata import PackageNotFoundError, requires

    from scenegen.run.software import installed

    lacks: dict[str, list[str]] = {}
    with suppress(PackageNotFoundError):  # a checkout that is not installed
        for line in requires("scenegen-lidar") or ():
            package, *extra = re.findall(r"^[\w-]+|(?<=extra == ')\w+", line)
            for name in extra:
                lacks.setdefault(name, []).extend([package] * (installed(package) == "absent"))
    return {
        extra: " ".join(["lacks", *names] if names else ["ok"]) for extra, names in lacks.items()
    }


def self_test() -> Json:
    """Draws samples for two seconds and holds them to their laws: every return lies in an occupied
    voxel, and a sample drawn again is the same to the bit."""
    from scenegen import draw
    from scenegen.recipe import preset
    from scenegen.source import DrawnWorlds

    recipe = preset("pillar")
    source = DrawnWorlds(recipe)

    def drawn(unit: int) -> Any:
        return draw.draw_unit(source, recipe, seed=0, split="train", unit=unit).samples

    first = drawn(0)  # compiles, where nothing is cached
    repeatable = [one.sha256() for one in first] == [one.sha256() for one in drawn(0)]
    begin, units, samples, contained = time.perf_counter(), 0, 0, True
    while time.perf_counter() - begin < SELF_TEST_S:
        found = drawn(units)
        units, samples = units + 1, samples + len(found)
        contained &= not any((one.observed & ~one.occupancy).any() for one in found)
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
    try:
        import torch
    except ModuleNotFoundError:
        return "unknown (torch is not installed)" if shutil.which("nvidia-smi") else "none"
    return torch.cuda.get_device_name(0) if torch.cuda.is_available() else "none"


@command("completion bash", "completion zsh")
@click.argument("shell", type=Choice(["bash", "zsh", "fish"]))
@click.pass_context
def completion(ctx: click.Context, shell: str) -> None:
    """Print a completion script: eval "$(scenegen completion bash)"."""
    found = get_completion_class(shell)
    assert found is not None
    print(found(ctx.find_root().command, {}, "scenegen", "_SCENEGEN_COMPLETE").source())
