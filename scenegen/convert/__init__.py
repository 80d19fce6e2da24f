"""Datasets in other programs' formats.

`files` holds the formats of single samples, `recordings` those that a viewer plays, and `convert`
writes a whole dataset in one of them. A user's own format is a class as `MODULE:CLASS`.
"""

from dataclasses import dataclass
from typing import Literal

from lidarsim.parameters import Checked, number
from lidarsim.registry import Registry

FILES, RECORDINGS = "scenegen.convert.formats", "scenegen.convert.recordings"
FORMATS = Registry(
    "format",
    {
        "semantickitti": f"{FILES}:SemanticKitti",
        "occ3d": f"{FILES}:Occ3d",
        "npz": f"{FILES}:Npz",
        "ply": f"{FILES}:Ply",
        "pcd": f"{FILES}:Pcd",
        "octomap": f"{FILES}:OctoMap",
        "webdataset": f"{FILES}:WebDataset",
        "rerun": f"{RECORDINGS}:Rerun",
    },
    needs={
        "names": "a method: (split, number) -> the files of a sample",
        "encode": "a method: (sample, grid, lidar) -> their contents, in order, or the only one",
    },
)
"""Formats by name: classes made with the `Choices`.

A format with a number `together` puts that many samples into one file; its `encode` takes a list of
(number, sample) in place of a sample.
"""


@dataclass(frozen=True, kw_only=True)
class Choices(Checked):
    """How samples are converted. Each format takes what concerns it."""

    unseen_invalid: bool = False
    """SemanticKITTI: mark voxels that no ray met as invalid. What is behind things is then left out
    of the score, and with it the task."""
    label: int = number(50, least=1, most=65535)
    """SemanticKITTI: the label of occupied voxels without a class, or of one that it lacks. 50 is
    its building, which its own table of classes keeps; its "other" labels count as empty there."""
    frame: Literal["body", "world"] = "body"
    """Frame of points: the body, or the world."""
