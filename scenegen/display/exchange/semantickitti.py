"""SemanticKITTI's voxel grids, for programs that read its scene-completion task.

Its development kit (semantic-kitti.org, "voxels") defines them: a grid in C order of x, y, z;
`.bin` and `.invalid` are bits, the first voxel highest; `.label` is uint16. Ours are as large as
the dataset's grid, the sensor in the middle and axes along the world's, where SemanticKITTI's begin
at the car.
"""

import numpy as np

from lidarsim import GridSpec, Sensor
from scenegen.display.exchange.choices import Choices
from scenegen.sample import Sample

SEQUENCES = {"train": "00", "val": "08", "test": "11"}
"""Sequences that SemanticKITTI's own lists put in these splits."""


class SemanticKitti:
    """``sequences/00/voxels/000007.bin``, the observed voxels; ``.label``, the truth; and
    ``.invalid``, all zero unless unseen voxels are to be left out."""

    def __init__(self, choices: Choices):
        self.choices = choices

    def names(self, split: str, number: int) -> tuple[str, ...]:
        """The files of a sample."""
        stem = f"sequences/{SEQUENCES[split]}/voxels/{number:06d}"
        return f"{stem}.bin", f"{stem}.label", f"{stem}.invalid"

    def encode(self, sample: Sample, grid: GridSpec, lidar: Sensor) -> tuple[bytes, ...]:
        """Their contents."""
        observed, occupancy = sample.observed, sample.occupancy
        labels = np.multiply(occupancy, self.choices.label, dtype="<u2")
        if self.choices.unseen_invalid:
            invalid = np.packbits(~(observed | sample.free)).tobytes()
        else:
            invalid = bytes(-(-observed.size // 8))
        return np.packbits(observed).tobytes(), labels.tobytes(), invalid
