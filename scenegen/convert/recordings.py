"""The format of Rerun's recordings (rerun.io), a hundred samples a file."""

import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim import Sensor
from lidarsim.grid import GridSpec
from scenegen.convert import Choices
from scenegen.convert.formats import Together
from scenegen.draw.sample import Sample
from scenegen.view.canvas import HEIGHTS, MISSED, SENSOR, colour
from scenegen.view.look import MASKS

FREE = (120, 190, 230)
"""Rerun's colour of free voxels."""


def rerun() -> Any:
    """Import Rerun without its usage reports.

    Rerun reports unless the user's settings forbid it or `CI` is set. `FORCE_RERUN_ANALYTICS`
    overrides both, and `TELEMETRY_ENABLED` lets it send traces.
    """
    os.environ.pop("FORCE_RERUN_ANALYTICS", None)
    os.environ.update(CI="true", TELEMETRY_ENABLED="false")
    import rerun as module

    return module


VIEWS = {"seen": "/scan /observed /sensor", "truth": "/occupancy /sensor"}
"""Views that Rerun shows side by side, and the entities in each."""


class Rerun(Together):
    """Rerun's recordings (rerun.io), on the timeline `sample`: ``scan`` and ``sensor``, and
    ``observed``, ``free`` and ``occupancy`` as centres of voxels, half a voxel large, in the world;
    and a blueprint with `VIEWS`."""

    suffix = ".rrd"

    def __init__(self, choices: Choices):
        super().__init__(choices)
        rerun()  # if it is not installed, fail before anything is written

    def encode(self, samples: list[tuple[int, Sample]], grid: GridSpec, lidar: Sensor) -> bytes:
        """Return the content of a file.

        Args:
            samples: Numbers and samples.
            grid: Grid of their maps.
            lidar: Their sensor.
        """
        library = rerun()
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "part.rrd"
            # without an id the library draws one: Rerun joins files of equal ids
            with library.RecordingStream("scenegen") as stream:
                stream.save(path)
                views = [
                    library.blueprint.Spatial3DView(name=view, contents=entities.split())
                    for view, entities in VIEWS.items()
                ]
                stream.send_blueprint(library.blueprint.Horizontal(*views))
                stream.log("/", library.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
                for number, sample in samples:
                    stream.set_time("sample", sequence=number)
                    for entity, (points, colours, radius) in _entities(sample, grid, lidar).items():
                        stream.log(entity, library.Points3D(points, colors=colours, radii=radius))
                stream.flush()
                stream.disconnect()
            return path.read_bytes()


def _entities(sample: Sample, grid: GridSpec, lidar: Sensor) -> dict[str, tuple[Any, Any, float]]:
    """Return points, colours and radius of each entity of a sample, by its name."""
    centres, half = grid.centres(sample.origin), grid.voxel_m / 2
    shades = (255 * colour(np.linspace(0, 1, grid.shape[2]), HEIGHTS)).astype(np.uint8)
    heights = np.broadcast_to(shades, (*grid.shape, 3))
    entities = {
        "scan": (sample.points(lidar), MISSED, half / 4),
        "sensor": (sample.position[None], SENSOR, half),
    }
    for name in MASKS:
        mask = getattr(sample, name)
        entities[name] = centres[mask], FREE if name == "free" else heights[mask], half
    return entities
