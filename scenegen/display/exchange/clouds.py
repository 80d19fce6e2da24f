"""A sample's returns as a cloud of points: .ply and .pcd; or all of a sample as NumPy's .npz."""

import io
import zipfile

import numpy as np

from lidarsim import GridSpec, Sensor
from scenegen.display.exchange.choices import Choices
from scenegen.display.points import encode_points
from scenegen.sample import Sample


class _Cloud:
    """One file a sample, ``train/000007.ply``."""

    suffix = ""

    def __init__(self, choices: Choices):
        self.choices = choices

    def names(self, split: str, number: int) -> tuple[str, ...]:
        """The file of a sample."""
        return (f"{split}/{number:06d}{self.suffix}",)

    def encode(self, sample: Sample, grid: GridSpec, lidar: Sensor) -> tuple[bytes, ...]:
        """Its content: returns x, y, z in float32, metres."""
        return (encode_points(self.suffix, sample.points(lidar, frame=self.choices.frame)),)


class Ply(_Cloud):
    """Binary PLY, little-endian."""

    suffix = ".ply"


class Pcd(_Cloud):
    """The Point Cloud Library's format 0.7, binary."""

    suffix = ".pcd"


class Npz(_Cloud):
    """Every field of the sample under its name, the returns under `points`, and the grid's
    `voxel_m`; compressed."""

    suffix = ".npz"

    def encode(self, sample: Sample, grid: GridSpec, lidar: Sensor) -> tuple[bytes, ...]:
        """Its content."""
        file = io.BytesIO()
        fields = {name: getattr(sample, name) for name in sample.names}
        points = sample.points(lidar, frame=self.choices.frame)
        fields |= {"points": points, "voxel_m": np.float64(grid.voxel_m)}
        with zipfile.ZipFile(
            file, "w", zipfile.ZIP_DEFLATED, compresslevel=1
        ) as members:  # NumPy has no levels
            for name, values in fields.items():
                with members.open(f"{name}.npy", "w") as member:
                    np.lib.format.write_array(member, np.asanyarray(values), allow_pickle=False)
        return (file.getvalue(),)
