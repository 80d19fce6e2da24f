"""Converts datasets to other programs' formats.

`formats` has the formats of single samples, `recordings` that of a viewer, and `convert` writes a
dataset in one of them. A user's own format is a class, given as `MODULE:CLASS`.
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
    """Parameters of formats. Each format uses those that concern it."""

    unseen_invalid: bool = False
    """SemanticKITTI: mark voxels that no ray met as invalid. Its score then ignores occluded
    voxels, which are those to complete."""
    label: int = number(50, minimum=1, maximum=65535)
    """SemanticKITTI: label of occupied voxels without a class, or with one that the format lacks.
    50 is a building. (SemanticKITTI counts its "other" labels as empty.)"""
    frame: Literal["body", "world"] = "body"
    """Frame of points: the body's, or the world's."""
    future: bool = False
    """Of datasets with movers: npz, webdataset and occ3d get `flow`, and the first two occupancy
    0.5, 1 and 2 s later."""
