"""`scenegen doctor` checks this machine; `completion` prints a script for the shell.

Versions and extras are pip's business: `pip show -f scenegen-lidar`, `pip check`.
"""

import importlib
import json
import shutil
import time
from typing import Any

import rich_click as click
from click.shell_completion import get_completion_class

from scenegen.base.errors import ScenegenError, printable
from scenegen.base.files import Json
from scenegen.cli.options import command, json_option
from scenegen.cli.show import announce_compilation, echo, flat, show_table
from scenegen.cli.types import Choice

LITTLE_GB = 5.0
"""Free disk below which `doctor` warns. A dataset of default size takes a quarter of a gigabyte,
and training takes more."""
SELF_TEST_S = 2.0
"""Duration of the self-test, seconds."""
COMPILED = ("mujoco", "ompl.geometric")
"""Compiled modules that worlds need. Even if installed, they may lack a library of the system."""


@command("doctor", "doctor --json")
@json_option
def doctor(as_json: bool) -> None:
    """Check this machine: MuJoCo, OMPL, GPU, cores, disk, cache, and a two-second self-test.

    \f
    Raises:
        ScenegenError: A module does not load, or the self-test failed.
    """
    if not as_json:
        announce_compilation()
    report = examine()
    if as_json:
        print(json.dumps(report))
    else:
        rows, advice = flat(report), _advice(report)
        marks = dict.fromkeys(rows, ("✓", "green")) | dict.fromkeys(advice, ("!", "yellow"))
        marks |= {name: ("✗", "red") for name, value in rows.items() if value is False}
        show_table(
            {name: f"{value}{advice.get(name, '')}" for name, value in rows.items()}, marks=marks
        )
    if not report["ok"]:
        raise ScenegenError(
            "MuJoCo, OMPL or the self-test failed: samples made here cannot be trusted; reinstall, "
            "then run it again"
        )
    if not as_json:
        echo("all is well")


def _advice(report: Json) -> dict[str, str]:
    """Return advice on shortcomings, by the name of the line that has them."""
    from lidarsim.jit import cache_trouble

    advice = {}
    if report["disk_free_gb"] < LITTLE_GB:
        advice["disk_free_gb"] = (
            f"; less than {LITTLE_GB:g} GB: free some before generating or training"
        )
    if cache_trouble("scenegen"):
        advice["kernel_cache"] = (
            "; kernels compile in every run: set SCENEGEN_CACHE to a folder that only you can write"
        )
    return advice


def examine() -> Json:
    """Examine this machine. `ok` is False if a module does not load or the self-test fails; the
    free disk is that of the working folder."""
    from lidarsim.jit import cache_folder, cache_trouble
    from scenegen.base.executors import cores

    loads = {name.partition(".")[0]: _loads(name) for name in COMPILED}
    # without the modules, the self-test could only raise
    test = self_test() if set(loads.values()) == {"loads"} else {"ok": False}
    return {
        "ok": test["ok"],
        **loads,
        "gpu": _gpu(),
        "cores": cores(),
        "disk_free_gb": round(shutil.disk_usage(".").free / 1e9, 1),
        "kernel_cache": cache_trouble("scenegen") or str(cache_folder("scenegen").parent),
        "self_test": test,
    }


def _loads(module: str) -> str:
    """Return "loads" if a module can be imported, else the reason."""
    try:
        importlib.import_module(module)
    # an installed module may lack a library of the system, which raises either
    except (ImportError, OSError) as error:
        return printable(error)
    return "loads"


def self_test() -> Json:
    """Draw samples for two seconds and check them: every return lies in an occupied voxel, and a
    sample drawn again has the same bits."""
    from scenegen.draw.draw import draw_unit
    from scenegen.draw.source import DrawnWorlds
    from scenegen.worlds.recipe import preset

    recipe = preset("pillar")
    source = DrawnWorlds(recipe)

    def drawn(unit: int) -> Any:
        return draw_unit(source, recipe, seed=0, split="train", unit=unit).samples

    first = drawn(0)  # compiles kernels, so it is not timed
    repeatable = [sample.sha256() for sample in first] == [sample.sha256() for sample in drawn(0)]
    begin, units, samples, contained = time.perf_counter(), 0, 0, True
    while time.perf_counter() - begin < SELF_TEST_S:
        unit = drawn(units)
        units, samples = units + 1, samples + len(unit)
        contained &= not any((sample.observed & ~sample.occupancy).any() for sample in unit)
    rate = samples / (time.perf_counter() - begin)
    return {
        "ok": repeatable and contained,
        "repeatable": repeatable,
        "returns_occupied": contained,
        "samples": samples,
        "samples_per_second_per_core": round(rate, 1),
    }


def _gpu() -> str:
    """Return the name of the GPU that torch finds, or "none"."""
    # torch is an extra, and takes seconds to load: only this line needs it
    try:
        import torch
    except ModuleNotFoundError:
        return "unknown: torch is not installed"
    return torch.cuda.get_device_name(0) if torch.cuda.is_available() else "none"


@command("completion bash", "completion zsh")
@click.argument("shell", type=Choice(["bash", "zsh", "fish"]))
@click.pass_context
def completion(ctx: click.Context, shell: str) -> None:
    """Print a completion script: eval "$(scenegen completion bash)".

    \f
    Args:
        ctx: The context, for the group of all commands.
        shell: Name of the shell.
    """
    complete = get_completion_class(shell)
    assert complete is not None
    print(complete(ctx.find_root().command, {}, "scenegen", "_SCENEGEN_COMPLETE").source())
