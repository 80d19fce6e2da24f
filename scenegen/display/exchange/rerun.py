"""Rerun's recordings (rerun.io), for its viewer. Its usage reporting is switched off before it is
imported."""

import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim import GridSpec, Sensor
from scenegen.display.colours import HEIGHTS, MISSED, SENSOR, colour
from scenegen.display.exchange.choices import Choices
from scenegen.sample import Sample

FREE = (120, 190, 230)
TIMELINE = "sample"


def rerun() -> Any:
    """The module, imported with its reporting off.

    It reports unless its user's settings forbid that or it is run by a machine (`CI`). One variable
    makes it report all the same, another lets it send traces.
    """
    os.environ.pop("FORCE_RERUN_ANALYTICS", None)
    os.environ.update(CI="true", TELEMETRY_ENABLED="false")
    import rerun as module

    return module


class Rerun:
    """``train-000000.rrd`` with the first samples on the timeline `sample`, and so on: ``scan`` and
    ``sensor``, ``observed``, ``free`` and ``occupancy`` as centres of voxels, half a voxel large,
    in the world."""

    together = 100

    def __init__(self, choices: Choices):
        pass

    def names(self, split: str, number: int) -> tuple[str, ...]:
        """The file that begins with a sample."""
        return (f"{split}-{number // self.together:06d}.rrd",)

    def encode(
        self, samples: list[tuple[int, Sample]], grid: GridSpec, lidar: Sensor
    ) -> tuple[bytes, ...]:
        """Its content."""
        library = rerun()
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "part.rrd"
            with library.RecordingStream(
                "scenegen", recording_id=f"scenegen-{samples[0][0]}"
            ) as stream:
                stream.save(path)
                stream.log("/", library.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
                for number, sample in samples:
                    stream.set_time(TIMELINE, sequence=number)
                    self._log(stream, library, sample, grid, lidar)
                stream.flush()
                stream.disconnect()
            return (path.read_bytes(),)

    def _log(
        self, stream: Any, library: Any, sample: Sample, grid: GridSpec, lidar: Sensor
    ) -> None:
        centres, half = grid.centres(sample.origin), grid.voxel_m / 2
        shares = np.linspace(0, 1, grid.shape[2])
        heights = np.broadcast_to(
            (255 * colour(shares, HEIGHTS)).astype(np.uint8), (*grid.shape, 3)
        )
        stream.log(
            "scan",
            library.Points3D(
                sample.points(lidar).astype(np.float32), colors=MISSED, radii=half / 4
            ),
        )
        stream.log(
            "sensor",
            library.Points3D(sample.position[None].astype(np.float32), colors=SENSOR, radii=half),
        )
        for name in ("observed", "free", "occupancy"):
            mask = getattr(sample, name)
            shades = FREE if name == "free" else heights[mask]
            stream.log(
                name, library.Points3D(centres[mask].astype(np.float32), colors=shades, radii=half)
            )
