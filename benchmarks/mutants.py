"""How many small faults in the code the tests find: mutants drawn by a fixed seed, each tested.

    python benchmarks/mutants.py --count 200 --out mutants.json

A mutant is one operator, number or branch changed, as cosmic-ray draws them. It is made in a copy
of the checkout, and killed if the tests of its room fail. Given again with the same `--out`, a run
that was stopped goes on.
"""

import ast
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import measuring

ROOT = Path(__file__).parents[1]
ROOMS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "rays": (("lidarsim/engines/*.py",), ("tests/lidarsim/engines",)),
    "truth": (("scenegen/truth/[!g]*.py",), ("tests/scenegen/truth",)),
    "voxelize": (("lidarsim/voxelize.py",), ("tests/lidarsim/test_voxelize.py", "tests/lidarsim")),
    "losses": (
        ("model/losses.py",),
        ("tests/model/test_losses.py", "tests/model/test_objective.py"),
    ),
    "planning": (("model/*/planning/*.py",), ("tests/model/evaluation",)),
    "statistics": (("model/*/statistics.py",), ("tests/model/evaluation",)),
    "manifest": (
        ("scenegen/dataset/manifest.py", "scenegen/dataset/trust.py"),
        ("tests/scenegen/dataset", "tests/scenegen/verification"),
    ),
}
"""What is mutated by room, and the tests that are run first to last."""
SEED = 1
TIMEOUT_S = 600


def drawn(count: int, rooms: list[str]) -> list[dict[str, Any]]:
    """`count` mutants, as many of every room."""
    from cosmic_ray.commands.init import _all_work_items

    rng, found = random.Random(SEED), list[dict[str, Any]]()
    for number, room in enumerate(rooms):
        files = sorted(path for pattern in ROOMS[room][0] for path in ROOT.glob(pattern))
        pool = [item.mutations[0] for item in _all_work_items(files, {})]
        pool = [one for one in pool if _counts(one)]
        share = count // len(rooms) + (number < count % len(rooms))
        for one in rng.sample(pool, min(share, len(pool))):
            found.append(
                {
                    "room": room,
                    "file": str(Path(one.module_path).relative_to(ROOT)),
                    "operator": one.operator_name,
                    "occurrence": one.occurrence,
                    "line": one.start_pos[0],
                }
            )
    return found


def _counts(one: Any) -> bool:
    """Whether a mutant changes what is computed."""
    spans = _spared(Path(one.module_path))
    decorator = "decorator" in one.operator_name.lower()
    return not decorator and not any(low <= one.start_pos < high for low, high in spans)


@cache
def _spared(path: Path) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Where a file has annotations, decorators, assertions and errors: from, to (line, column)."""
    spared: list[Any] = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        match node:
            case ast.FunctionDef():
                spared += [node.returns, *node.decorator_list]
            case ast.arg() | ast.AnnAssign():
                spared.append(node.annotation)
            case ast.Raise() | ast.Assert():
                spared.append(node)
    return [
        ((node.lineno, node.col_offset), (node.end_lineno, node.end_col_offset))
        for node in spared
        if node is not None
    ]


def tested(copy: Path, mutant: dict[str, Any]) -> str:
    """Make the mutant in `copy`, test, and undo it: "killed", "survived" or "no mutant"."""
    from cosmic_ray.mutating import use_mutation
    from cosmic_ray.plugins import get_operator

    pytest = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0"]
    environment = os.environ | {"PYTHONPATH": str(copy), "OMP_NUM_THREADS": "1"}
    operator = get_operator(mutant["operator"])()
    with use_mutation(copy / mutant["file"], operator, mutant["occurrence"]) as (_, mutated):
        if mutated is None:
            return "no mutant"
        for tests in ROOMS[mutant["room"]][1]:
            try:
                ended = subprocess.run(
                    [*pytest, tests],
                    cwd=copy,
                    env=environment,
                    capture_output=True,
                    timeout=TIMEOUT_S,
                    check=False,
                )
            except subprocess.TimeoutExpired:
                return "killed"
            if ended.returncode:
                return "killed"
    return "survived"


def main() -> None:
    """Draw, test, and print the share that was killed, and the survivors."""
    parser = measuring.options(__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--out", type=Path, default=Path("mutants.json"))
    parser.add_argument("--rooms", nargs="*", default=list(ROOMS))
    given = measuring.parse(parser, count=1, rooms=["losses"])
    held = (
        json.loads(given.out.read_text()) if given.out.exists() else drawn(given.count, given.rooms)
    )
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        copy = Path(folder).resolve() / "copy"
        shutil.copytree(
            ROOT, copy, symlinks=True, ignore=shutil.ignore_patterns(".git", ".venv", "data")
        )
        for mutant in held:
            if mutant["room"] in given.rooms and "end" not in mutant:
                mutant["end"] = tested(copy, mutant)
                given.out.write_text(json.dumps(held, indent=0))
                print(mutant["end"], mutant["file"], mutant["line"], mutant["operator"], flush=True)
    done = [mutant for mutant in held if mutant.get("end") in ("killed", "survived")]
    killed = sum(mutant["end"] == "killed" for mutant in done)
    print(f"{killed} of {len(done)} killed")


if __name__ == "__main__":
    main()
