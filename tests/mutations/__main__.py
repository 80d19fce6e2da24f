"""Run the campaign, a family, or one case; see the package."""

import argparse
import collections
import os
import pprint
import shlex
import shutil
import sys
import tempfile
import time
from pathlib import Path

from tests.mutations import __doc__ as about
from tests.mutations.formats import FAMILIES
from tests.mutations.valid import make_valid
from tests.mutations.warm import campaign


def main():
    """Print what went wrong, and a table; end with 1 where anything did."""
    asked = argparse.ArgumentParser(
        prog="tests.mutations", description=about, formatter_class=argparse.RawTextHelpFormatter
    )
    asked.add_argument("what", nargs="*", help="families, or cases as family/number; all for none")
    asked.add_argument("--cases", type=int, default=25, help="of each family")
    asked.add_argument("--seed", type=int, default=0)
    asked.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)))
    given = asked.parse_args()
    names = []
    for word in given.what or FAMILIES:
        names += [word] if "/" in word else [f"{word}/{number}" for number in range(given.cases)]
    base = Path(tempfile.mkdtemp(prefix="mutations-"))
    ends = run(names, seed=given.seed, jobs=given.jobs, base=base)
    if len(names) == 1:
        _print_whole(ends[0])
    elif not any(ended.wrong for ended in ends):
        shutil.rmtree(base)
    return print_table(ends)


def run(names, *, seed, jobs, base):
    """The cases called `names`, run in this process's own copies; what went wrong is printed as it
    comes."""
    (base / "valid").mkdir(parents=True)
    (base / "home").mkdir()
    begin = time.monotonic()
    valid = make_valid(base / "valid")
    print(f"warm after {time.monotonic() - begin:.1f} s; folder {base}, seed {seed}", flush=True)
    os.environ["HOME"] = str(base / "home")
    ends = []
    for ended in campaign(names, FAMILIES, valid, seed=seed, jobs=jobs, base=base):
        ends.append(ended)
        if ended.wrong:
            print(
                f"{ended.name} {ended.wrong}\n    {ended.attempt.damage}\n    "
                f"{shlex.join(ended.attempt.words)[:300]}",
                flush=True,
            )
    return ends


def print_table(ends):
    """Families, cases, how many ended with a result, how many went wrong, and the slowest."""
    families = collections.defaultdict(list)
    for ended in ends:
        families[ended.name.partition("/")[0]].append(ended)
    print("family          cases  results  wrong   slowest  most grown")
    for name, cases in families.items():
        passed = sum(case.result.code == 0 for case in cases)
        wrong = sum(bool(case.wrong) for case in cases)
        slowest = max(case.result.seconds for case in cases)
        grown = max(case.result.grown_bytes for case in cases) >> 20
        print(f"{name:<14}{len(cases):>7}{passed:>9}{wrong:>7}{slowest:>8.1f} s{grown:>9} MB")
    return int(any(ended.wrong for ended in ends))


def _print_whole(ended):
    pprint.pprint({"damage": ended.attempt.damage, "words": ended.attempt.words})
    pprint.pprint(vars(ended.result) | {"verdict": ended.wrong or "ended well"})


if __name__ == "__main__":
    sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    code = main()
    sys.stdout.flush()
    os._exit(code)  # libraries would complain of being left
