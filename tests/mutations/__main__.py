"""Run the campaign, a family, or one case; see the package."""

import argparse
import collections
import os
import pprint
import sys
import tempfile
from pathlib import Path

from tests.mutations import __doc__ as about
from tests.mutations.formats import FAMILIES
from tests.mutations.valid import make_valid
from tests.mutations.warm import campaign


def main():
    """Print what went wrong, and how many cases had a result; end with 1 where anything did."""
    parser = argparse.ArgumentParser(
        prog="tests.mutations", description=about, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("what", nargs="*", help="families, or cases as family/number; all for none")
    parser.add_argument("--cases", type=int, default=25, help="of each family")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)))
    options = parser.parse_args()
    names = []
    for word in options.what or FAMILIES:
        numbered = [f"{word}/{number}" for number in range(options.cases)]
        names += [word] if "/" in word else numbered
    base = Path(tempfile.mkdtemp(prefix="mutations-"))
    for name in ("valid", "home"):
        (base / name).mkdir()
    valid = make_valid(base / "valid")
    os.environ["HOME"] = str(base / "home")
    print(f"folder {base}, seed {options.seed}", flush=True)
    wrong, results = 0, collections.Counter()
    for ended in campaign(names, valid, seed=options.seed, jobs=options.jobs, base=base):
        results[ended.name.partition("/")[0]] += ended.result.code == 0
        wrong += bool(ended.wrong)
        if ended.wrong or len(names) == 1:
            pprint.pprint(ended)
    print(f"{len(names)} cases; with a result: {dict(results)}; {wrong} wrong")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    code = main()
    sys.stdout.flush()
    os._exit(code)  # libraries would complain of being left
