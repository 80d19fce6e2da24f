"""The datasets that a command takes where it takes several: those named, or all under data/."""

from pathlib import Path

import rich_click as click

from scenegen.cli.progress import note


def find_datasets(datasets: tuple[Path | str, ...], *, shown: bool) -> tuple[Path, ...]:
    """The folders of the datasets named, or those under data/ that hold samples. Raises UsageError
    for none."""
    from scenegen.dataset.locate import locate
    from scenegen.dataset.trust import load

    found = tuple(locate(dataset, shown=shown) for dataset in datasets)
    if not found:
        there = {
            path.parent: load(path.parent) for path in sorted(Path("data").glob("*/dataset.json"))
        }
        found = tuple(folder for folder, manifest in there.items() if manifest.shards)
        for folder in there.keys() - set(found) if shown else ():
            note(f"{folder}: holds no samples yet, so it is left out")
    if not found:
        raise click.UsageError(
            "no dataset given, and none under data/; make one with `scenegen generate --kind "
            "pillar`"
        )
    return found
