"""`scenegen inspect`: what something is."""

from pathlib import Path
from typing import Any

import rich_click as click

from scenegen.cli.inspect import inspect_options, show


@click.command()
@inspect_options
def inspect(dataset: Path | str, as_json: bool, **options: Any) -> None:
    """Print what is in a dataset: counts, sizes, and statistics of scans and truth.

    A folder of datasets is listed; of a world (.xml), a scan, a file of predictions (.h5), or a
    run's folder, it says what it is.
    """
    show(dataset, as_json=as_json, others=_others, misfit=_misfit, **options)


def _others(path: Path) -> dict[str, Any] | None:
    from scenegen.model.completion.points import READERS

    if path.suffix in READERS:
        from scenegen.model.facts import scan_facts

        return scan_facts(path)
    if path.suffix == ".h5":
        from scenegen.model.facts import prediction_facts

        return prediction_facts(path)
    if (path / "metrics.csv").is_file():
        from scenegen.model.facts import run_facts

        return run_facts(path)
    return None


def _misfit(grid: Any) -> list[str]:
    from scenegen.model.config import NetworkConfig

    try:
        NetworkConfig(height=grid.shape[2]).check_map(grid.shape)
    except ValueError as error:
        return [str(error)]
    return []
