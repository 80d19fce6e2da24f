"""What each extra weighs on disk, with all that it needs: the table of docs/install.md.

python benchmarks/extras.py          needs an environment with all extras; reads what is installed
"""

from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

import measuring
from packaging.requirements import Requirement

PROJECT = "scenegen-lidar"


def closure(name: str, extra: str, found: dict[str, Distribution]) -> None:
    """Add to `found` all that a package needs, itself included, with one of its extras."""
    try:
        it = found.setdefault(name, distribution(name))
    except PackageNotFoundError:
        print(f"{name} is not installed, and left out")
        return
    for line in it.requires or ():
        need = Requirement(line)
        wanted = not need.marker or need.marker.evaluate({"extra": extra})
        if wanted and (extra or need.name not in found):
            for one in ("", *need.extras):
                closure(need.name, one, found)


def megabytes(it: Distribution) -> float:
    """The size of an installed package."""
    paths = (Path(str(it.locate_file(file))) for file in it.files or ())
    return sum(path.stat().st_size for path in paths if path.is_file()) / 1e6


def main() -> None:
    """Print the table."""
    measuring.parse(measuring.Options)
    core: dict[str, Distribution] = {}
    closure(PROJECT, "", core)
    sizes = {name: megabytes(it) for name, it in core.items()}
    print(f"| | MB | most of it |\n|---|---|---|\n{row('the core', sizes)}")
    for extra in distribution(PROJECT).metadata.get_all("Provides-Extra") or ():
        found: dict[str, Distribution] = {}
        closure(PROJECT, extra, found)
        print(row(f"`[{extra}]`", {n: megabytes(it) for n, it in found.items() if n not in core}))


def row(name: str, sizes: dict[str, float]) -> str:
    """A row: the sum, and the three largest parts."""
    largest = sorted(sizes, key=lambda one: -sizes[one])[:3]
    told = ", ".join(f"{one} {sizes[one]:.0f}" for one in largest)
    return f"| {name} | {sum(sizes.values()):.0f} | {told} |"


if __name__ == "__main__":
    main()
