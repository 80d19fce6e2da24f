"""`scenegen sensors`: the sensors that there are, and pictures of their patterns."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from lidarsim.sensors import CATALOGUE, RASTER, SENSORS
from scenegen.cli.options import json_option, out_option
from scenegen.cli.show import say, show_figures, show_table
from scenegen.cli.types import Named

if TYPE_CHECKING:
    from lidarsim import Sensor


@click.command()
@click.argument(
    "names", nargs=-1, metavar="[NAME|FILE.toml|MODULE:CLASS]…", type=Named(SENSORS, file=".toml")
)
@out_option(
    "A picture (.png) of the patterns, azimuth × elevation, one below the other.", file=True
)
@json_option
def sensors(names: tuple[str, ...], out: Path | None, as_json: bool) -> None:
    """List the sensors that there are, or tell of those named, and draw their patterns.

    Each goes into `scenegen generate --lidar NAME`, or into a recipe as `[lidar] sensor = "NAME"`.
    """
    from scenegen.lidar import beam_table, named_lidar

    found = {name: named_lidar(name) for name in names or (RASTER, *CATALOGUE)}
    for name in names:
        try:
            beam_table(found[name])
        except ValueError as error:
            raise click.ClickException(f"{name}: {error}") from None
    rows = {name: _figures(sensor) for name, sensor in found.items()}
    if out is not None:
        from scenegen.display.pattern import draw_patterns
        from scenegen.files import write_result

        write_result(out, draw_patterns(list(found.values())))
    if as_json:
        print(json.dumps(rows))
    elif names:
        for name, row in rows.items():
            show_table({key: value for key, value in row.items() if value not in ("", [])}, name)
    else:
        cells = {name: [_cell(row[head]) for head in HEADS] for name, row in rows.items()}
        show_figures(cells, list(HEADS.values()))
        say("\nscenegen sensors NAME tells where its figures come from; --out FILE draws it")


HEADS = {
    "shape": "rays",
    "elevation_deg": "up, °",
    "azimuth_deg": "around, °",
    "scan_s": "scan, s",
    "max_range_m": "m",
}
"""The columns of the list."""


def _figures(sensor: "Sensor") -> dict[str, Any]:
    """What is to be said of a sensor, as plain JSON values; angles are measured on its rays."""
    import numpy as np

    from lidarsim.sensors.device import angles_deg

    up, around = angles_deg(sensor.directions_body)
    return {
        "shape": list(sensor.shape),
        "elevation_deg": [round(float(up.min()), 2), round(float(up.max()), 2)],
        "azimuth_deg": [round(float(around.min()), 2), round(float(around.max()), 2)],
        "scan_s": round(float(np.max(sensor.times_s)), 6),
        "min_range_m": getattr(sensor, "min_range_m", 0.0),
        "max_range_m": sensor.max_range_m,
        "noise": getattr(sensor, "noise", ""),
        "source": getattr(sensor, "source", "") or str(sensor),
        "checked": getattr(sensor, "checked", ""),
        "error": getattr(sensor, "error", ""),
    }


def _cell(value: Any) -> str:
    """A figure for the list: 16 × 1808, or -15 … 15."""
    if not isinstance(value, list):
        return f"{value:g}"
    return (
        " … ".join(f"{one:g}" for one in value)
        if isinstance(value[0], float)
        else " × ".join(map(str, value))
    )
