"""`scenegen doctor`: whether this machine is fit, and what would make it so."""

import json
from typing import Any

import rich_click as click

from scenegen.cli.options import json_option
from scenegen.cli.progress import announce_compilation
from scenegen.cli.show import flat, show_table
from scenegen.errors import ScenegenError, needs

LITTLE_GB = 5.0
"""Free disk below which `doctor` warns: a dataset of default size takes a quarter of a gigabyte, a
run some more."""


@click.command()
@json_option
def doctor(as_json: bool) -> None:
    """Check this machine: versions, cores, disk, GPU, and a two-second self-test."""
    if not as_json:
        announce_compilation()
    from lidarsim.jit import cache_trouble
    from scenegen.cli.examine import examine

    found = examine()
    if as_json:
        print(json.dumps(found))
    else:
        rows, advice = flat(found), _advice(found, cached=not cache_trouble("scenegen"))
        marks = {
            name: ("✗", "red")
            if value is False
            else ("!", "yellow")
            if name in advice
            else ("✓", "green")
            for name, value in rows.items()
        }
        show_table(
            {name: f"{value}{advice.get(name, '')}" for name, value in rows.items()}, marks=marks
        )
    if not found["ok"]:
        raise ScenegenError(
            "the self-test failed: samples made here cannot be trusted; reinstall, then run it "
            "again"
        )


def _advice(found: dict[str, Any], *, cached: bool) -> dict[str, str]:
    """What to do about what is missing, by the name of its line."""
    advice = {}
    if found["torch"] == "absent":
        advice["torch"] = f"; training a network and completing with one {needs('torch', 'train')}"
    if found["disk_free_gb"] < LITTLE_GB:
        advice["disk_free_gb"] = (
            f"; less than {LITTLE_GB:g} GB: free some before generating or training"
        )
    if not cached:
        advice["kernel_cache"] = (
            "; kernels compile in every run: set SCENEGEN_CACHE to a folder that only you can write"
        )
    return advice
