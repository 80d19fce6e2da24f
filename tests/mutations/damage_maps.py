"""Family ``maps``: OctoMaps with bytes damaged anywhere, and with headers that say otherwise; and
ROS's plans, the picture or the YAML."""

import numpy as np

from tests.mutations.case import Attempt, refuses, words
from tests.mutations.damage_bytes import damage
from tests.mutations.nasty import ESCAPES, REAL
from tests.scenegen.worlds.test_octomap import written
from tests.scenegen.worlds.test_plan import write

STATES = np.random.default_rng(0).integers(0, 3, (6, 5, 4)).astype(np.uint8)
CORNERS = ((0, 0, 0), (-3, -3, -2), (30_000, -32_768, 5))
LINES = {
    "res 0.1": ("res 0", "res 1e-300", "res nan", f"res {ESCAPES}", "res"),
    "id OcTree": ("id ColorOcTree", f"id {ESCAPES}", "id"),
    "size 9": ("x" * 100_000,),
}
COMMANDS = ("inspect map{} --json", "scan map{} --pose 0.2,0.2,0.2,0 --quiet -o a.ply")


def attempt(random, valid, here):
    """A damaged map, looked at or scanned."""
    suffix, must_fail = random.choice((".bt", ".ot", ".yaml")), False
    if suffix == ".yaml":
        return _plan(random, here)
    content = written(STATES, random.choice(CORNERS), suffix)
    if random.random() < 0.2:
        line, must_fail = random.choice(list(LINES)), True
        said = random.choice(LINES[line])
        content = content.replace(line.encode(), said.encode())
    elif random.random() < 0.5:
        begin = content.index(b"\ndata\n") + 6
        tree, said = damage(content[begin:], random)
        content, said = content[:begin] + tree, f"tree: {said}"
    else:
        content, said = damage(content, random)
    (here / f"map{suffix}").write_bytes(content)
    said = f"map{suffix}: {ascii(said)[:60]}"
    command = words(random.choice(COMMANDS).format(suffix))
    makes = ("a.ply",) if command[0] == "scan" else ()
    if must_fail:
        return Attempt(words=command, damage=said, makes=makes, holds=refuses(said))
    return Attempt(words=command, damage=said, makes=makes)


def _plan(random, here):
    """A damaged plan, scanned or made a map of."""
    write(here)
    if random.random() < 0.5:
        path = here / random.choice(("plan.yaml", "plan.pgm"))
        content, said = damage(path.read_bytes(), random)
        path.write_bytes(content)
    else:
        path, said = here / "plan.yaml", random.choice((*map(repr, REAL), ESCAPES, "[" * 999))
        fields = path.read_text().split(" ")
        fields[random.randrange(len(fields))] = said
        path.write_text(" ".join(fields))
    command, made = random.choice(
        (("map plan.yaml --quiet -o a.npz", "a.npz"), (COMMANDS[1].format(".yaml"), "a.ply"))
    )
    command = command.replace("map.yaml", path.with_suffix(".yaml").name)
    said = f"{path.name}: {ascii(said)[:60]}"
    return Attempt(words=words(command), damage=said, makes=(made,))
