"""Family ``options``: every command's own options, from its own list, with values that nobody
expects."""

import glob
import os
from pathlib import Path

import click

from tests.command_line import beside, rows
from tests.mutations.case import Attempt, words
from tests.mutations.nasty import number, text

MADE = dict(rows(beside(__file__, "commands.txt")))
"""Commands as they work, but for those that take seconds; what a case changes comes after, and so
holds."""
KEPT = ("pipe", "loop")
"""Neither files nor folders: nothing replaces them, even where it is asked to."""


def attempt(random, valid, here):
    """A command with one or two options that say something odd."""
    from scenegen.__main__ import app

    valid.put("d", here)
    valid.put("recipe.toml", here)
    valid.put("n.safetensors", here)
    (here / "w.xml").write_text('<mujoco><worldbody><geom size="1"/></worldbody></mujoco>')
    os.mkfifo(here / "pipe")
    (here / "loop").symlink_to("loop")
    (here / "file").write_text("the user's own\n")
    (here / "folder").mkdir()
    name = random.choice(list(MADE))
    parameters = [
        parameter
        for parameter in app.registry.find(name).params
        if parameter.name not in ("as_json", "quiet")
    ]
    words = [name, *MADE[name].split()]
    damage, makes = [], ["out*"]
    for parameter in random.choices(parameters, k=random.choice((1, 1, 2))):
        values = _values(parameter, random)
        if isinstance(parameter, click.Argument):
            words[1:2] = values if len(words) > 1 else [*values]
        else:
            words += [random.choice(parameter.opts), *values]
        if parameter.name in ("out", "output") and values[0] not in KEPT:
            asked = Path(os.path.normpath(values[0]))
            paths = [glob.escape(str(path)) for path in (asked, *asked.parents[:-1])]
            makes += [*paths, f"{paths[0]}/*"]
        damage.append(f"{parameter.name} = {ascii(values)[:80]}")
    if "--keep" in words:
        makes.append("*/figures-*")
    return Attempt(
        words=tuple(words), damage="; ".join(damage), makes=tuple(makes), may_lack_memory=True
    )


VALUES = words(
    "0 -1 2 1.5 1e3 nan inf -inf 1_000 ٣ 0x10 pipe loop file folder d d/dataset.json "
    "missing/deep/x /dev/null/x file/x /proc/self/mem"
)


def _values(parameter, random):
    """Values of the option, as words; none for a switch."""
    if getattr(parameter, "is_flag", False):
        return []
    odd = " 1", "1" * 400, text(random), str(number(random))[:500]
    return [random.choice((*VALUES, *odd)) for _ in range(max(parameter.nargs, 1))]
