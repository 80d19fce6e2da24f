"""Family ``options``: every command's own options, from its own list, with values that nobody
expects."""

import glob
import os
from pathlib import Path

import click

from tests.command_line import rows
from tests.mutations.case import Attempt, words
from tests.mutations.nasty import number, text

MADE = """
generate   → --recipe recipe.toml --n 1 --val 0 --test 0 --workers 1 --quiet --out out
inspect    → d --json
world      → d 0 -o out.xml
verify     → d --quick --workers 1 --quiet
complete   → d --weights n.safetensors --device cpu --quiet -o out
bench      → d --quick --workers 1 --quiet --method returns --out out
sensors    → velodyne-vlp-16 --out out.png
scan       → w.xml --pose 0,0,2,0 --lidar velodyne-vlp-16 -o out.ply
take       → d --quiet --workers 1 -o out.json
calibrate  → n.safetensors d --quiet -o out.safetensors
view       → d --html out.html --quiet
render     → d -o out.png
convert    → d --to npz --quiet -o out
recipe     → pillar -o out.toml
completion → bash
"""
MADE = dict(rows(MADE))
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
    command = app.registry.find(name)
    words = [name, *MADE[name].split()]
    ends = ("", ".png", ".ply", ".html", ".toml", ".safetensors", ".xml", ".onnx", ".json")
    done, asked = [], [f"out{end}" for end in ends]
    parents = []
    for _ in range(random.choice((1, 1, 2))):
        parameter = random.choice([p for p in command.params if p.name not in ("as_json", "quiet")])
        value = _values(parameter, random)
        if isinstance(parameter, click.Argument):
            words[1:2] = value if len(words) > 1 else [*value]
        else:
            words += [random.choice(parameter.opts), *value]
        if parameter.name in ("out", "output") and value[0] not in KEPT:
            wanted = Path(os.path.normpath(value[0]))
            asked.append(glob.escape(str(wanted)))
            parents += [glob.escape(str(path)) for path in wanted.parents[:-1]]
        done.append(f"{parameter.name} = {ascii(value)[:80]}")
    if "--keep" in words:
        parents.append("*/figures-*")
    return Attempt(
        words=tuple(words),
        damage="; ".join(done),
        makes=(*parents, *(pattern for name in asked for pattern in (name, f"{name}/*"))),
        may_lack_memory=True,
    )


def _values(parameter, random):
    """A value of the option, as words; none for a switch."""
    if getattr(parameter, "is_flag", False):
        return []
    count = parameter.nargs if parameter.nargs > 1 else 1
    small = (
        *words("0 -1 2 1.5 1e3 nan inf -inf 1_000"),
        " 1",
        "٣",
        "0x10",
        "1" * 400,
    )
    if isinstance(
        parameter.type, click.types.IntParamType | click.types.FloatParamType | click.Tuple
    ):
        return [random.choice((*small, text(random))) for _ in range(count)]
    paths = words(
        "pipe loop file folder d d/dataset.json missing/deep/x /dev/null/x file/x /proc/self/mem"
    )
    return [
        random.choice((*paths, *paths, text(random), str(number(random))[:500]))
        for _ in range(count)
    ]
