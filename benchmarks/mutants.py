"""How many small faults in the code the tests find: mutants drawn by a fixed seed, each tested.

    python benchmarks/mutants.py --count 200 --out mutants.json

A mutant is one operator, number or branch changed, as cosmic-ray draws them. It is made in a copy
of the checkout, and killed if the tests of its room fail. Given again with the same `--out`, a run
that was stopped goes on.
"""

import json
import os
import random
import re
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import measuring
from cosmic_ray.commands.init import _all_work_items
from cosmic_ray.mutating import use_mutation
from cosmic_ray.plugins import get_operator
from cosmic_ray.testing import run_tests

ROOT = Path(__file__).parents[1]
ROOMS = {
    "rays": ("lidarsim/engines/*.py", "tests/lidarsim/engines"),
    "truth": ("scenegen/truth/[!g]*.py", "tests/scenegen/truth"),
    "voxelize": ("lidarsim/voxelization.py", "tests/lidarsim/test_voxelization.py tests/lidarsim"),
    "losses": ("model/losses.py", "tests/model/test_losses.py"),
    "planning": ("model/bench/planner.py model/bench/trials.py", "tests/model/bench"),
    "statistics": ("model/bench/statistics.py", "tests/model/bench"),
    "manifest": (
        "scenegen/dataset/manifest.py scenegen/dataset/schema.py scenegen/dataset/collection.py",
        "tests/scenegen/dataset tests/scenegen/verification",
    ),
}
"""What is mutated by room, and the tests that are run first to last."""
SPARED = re.compile(r" *(@|raise |assert |def |\w+: )")
"""Lines that are not mutated: decorators, errors, assertions, and what has an annotation."""
SEED = 1
TIMEOUT_S = 600


class Options(measuring.Options):
    """How many, and where."""

    count: int = 200
    out: Path = Path("mutants.json")
    rooms: Sequence[str] = tuple(ROOMS)


def drawn(count: int, rooms: Sequence[str]) -> list[dict[str, Any]]:
    """`count` mutants, as many of every room."""
    rng, found = random.Random(SEED), list[dict[str, Any]]()
    for number, room in enumerate(rooms):
        files = sorted(path for pattern in ROOMS[room][0].split() for path in ROOT.glob(pattern))
        pool = [item.mutations[0] for item in _all_work_items(files, {})]
        pool = [one for one in pool if _counts(one)]
        share = count // len(rooms) + (number < count % len(rooms))
        found += [
            {
                "room": room,
                "file": str(Path(one.module_path).relative_to(ROOT)),
                "operator": one.operator_name,
                "occurrence": one.occurrence,
                "line": one.start_pos[0],
            }
            for one in rng.sample(pool, min(share, len(pool)))
        ]
    return found


def _counts(one: Any) -> bool:
    """Whether a mutant changes what is computed."""
    line = Path(one.module_path).read_text().splitlines()[one.start_pos[0] - 1]
    return not SPARED.match(line)


def tested(mutant: dict[str, Any]) -> str:
    """Make the mutant in the copy that is the current folder, test, and undo it: "killed",
    "survived" or "no mutant"."""
    command = f"{sys.executable} -m pytest -x -q -n 0 {ROOMS[mutant['room']][1]}"
    operator = get_operator(mutant["operator"])()
    with use_mutation(Path(mutant["file"]), operator, mutant["occurrence"]) as (_, mutated):
        return "no mutant" if mutated is None else str(run_tests(command, TIMEOUT_S)[0].value)


def main() -> None:
    """Draw, test, and print the share that was killed, and the survivors."""
    given = measuring.parse(Options, count=1, rooms=["losses"])
    out = given.out.resolve()
    held = json.loads(out.read_text()) if out.exists() else drawn(given.count, given.rooms)
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        copy = Path(folder).resolve() / "copy"
        shutil.copytree(
            ROOT, copy, symlinks=True, ignore=shutil.ignore_patterns(".git", ".venv", "data")
        )
        os.environ |= {"PYTHONPATH": str(copy), "OMP_NUM_THREADS": "1"}
        os.chdir(copy)
        for mutant in held:
            if mutant["room"] in given.rooms and "end" not in mutant:
                mutant["end"] = tested(mutant)
                out.write_text(json.dumps(held, indent=0))
                print(mutant["end"], mutant["file"], mutant["line"], mutant["operator"], flush=True)
    ends = [mutant["end"] for mutant in held if mutant.get("end") in ("killed", "survived")]
    print(f"{ends.count('killed')} of {len(ends)} killed")


if __name__ == "__main__":
    main()
