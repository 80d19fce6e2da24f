"""Recordings of Rerun (rerun.io), a hundred samples a file."""

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
    """Imports Rerun with its usage reporting off.

    It reports unless its user's settings forbid that or it is run by a machine (`CI`). One variable
    makes it report all the same, another lets it send traces.
    """
    os.environ.pop("FORCE_RERUN_ANALYTICS", None)
    os.environ.update(CI="true", TELEMETRY_ENABLED="false")
    import rerun as module

    return module


VIEWS = {"seen": "/scan /observed /sensor", "truth": "/occupancy /sensor"}
"""What Rerun shows side by side at first."""


class Rerun(Together):
    """Rerun's recordings (rerun.io), on the timeline `sample`: ``scan`` and ``sensor``, and
    ``observed``, ``free`` and ``occupancy`` as centres of voxels, half a voxel large, in the world;
    and a blueprint with `VIEWS`."""

    suffix = ".rrd"

    def __init__(self, choices: Choices):
        super().__init__(choices)
        rerun()  # where it is missing, nothing is written

    def encode(self, samples: list[tuple[int, Sample]], grid: GridSpec, lidar: Sensor) -> bytes:
        """The content of a file."""
        library = rerun()
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "part.rrd"
            # the library draws an id: Rerun takes files of equal ids for one recording
            with library.RecordingStream("scenegen") as stream:
                stream.save(path)
                views = [
                    library.blueprint.Spatial3DView(name=view, contents=shown.split())
                    for view, shown in VIEWS.items()
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
    """Points, colours and radius of what is shown of a sample, by name."""
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
