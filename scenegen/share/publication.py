"""What is published: all that the card and the Croissant file say of a dataset, and the versions
that made it."""

import platform
import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from typing import Any

from scenegen import SPLITS, __version__
from scenegen.dataset.layout import DIGEST
from scenegen.dataset.trust import Manifest
from scenegen.share.licence import Licence

LOCK = "requirements.lock.txt"
_NAME = re.compile(r"[A-Za-z0-9][\w.-]*", re.ASCII)


def environment_lock(made_with: Mapping[str, str], commit: str = "unknown") -> str:
    """A requirements file of what scenegen needs, as installed here.

    Packages in `made_with`, the manifest's `software`, come in the version that made the dataset.
    scenegen itself stands in a comment, with the `commit` of its checkout: it is installed from its
    own source, and a line here would ask a package index for whatever bears its name there.
    """
    found = {
        name: made_with.get(name, number)
        for name, number in sorted(closure("scenegen-lidar").items())
    }
    made = made_with.get("scenegen", __version__)
    head = [
        f"# scenegen {made}, published with {__version__}, commit {commit}",
        f"# {platform.python_implementation()} {platform.python_version()}, {platform.system()} "
        f"{platform.machine()}",
    ]
    return "\n".join([*head, *(f"{name}=={number}" for name, number in found.items())]) + "\n"


def closure(package: str) -> dict[str, str]:
    """Name to version of every installed distribution that `package` needs, without extras, and
    without itself."""
    found: dict[str, str] = {}
    waiting = _needs(package)
    while waiting:
        name = waiting.pop()
        if name in found or name == package:
            continue
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # for another platform or Python
            continue
        waiting += _needs(name)
    return found


def _needs(package: str) -> list[str]:
    """Names of what a distribution requires, its extras left out."""
    names = []
    for requirement in requires(package) or []:
        wanted, _, marker = requirement.partition(";")
        match = _NAME.match(wanted)
        if match and "extra" not in marker:
            names.append(re.sub(r"[-_.]+", "-", match[0]).lower())
    return names


PAPER = (
    "Yu, Zhao, Xu: Planning-Oriented 3D Scene Completion via Coupled TUDF–Occupancy "
    "Representation Learning from "
    "Partial Observations"
)
KINDS = {
    "pillar": "random forests of round, square and oblong pillars",
    "geometric": "random spheres, boxes, cylinders and walls, standing and floating",
    "rooms": "storeys of buildings with rooms, doors, windows, ceilings and furniture",
    "street": "streets with houses, cars, poles, wires and trees",
    "forest": "forests on uneven ground",
    "cave": "caves with tunnels and chambers",
    "warehouse": "warehouses with racks, aisles, conveyors and trusses",
    "industrial": "machine halls with pipes, tanks, catwalks and scaffolds",
    "maze": "mazes in three dimensions with windows to fly through",
    "clutter": "clouds of shapes of all sizes",
    "scene": "worlds from MJCF files",
}


@dataclass(frozen=True, kw_only=True)
class Publication:
    """A dataset on its way to the Hub."""

    repository: str
    """user/name on the Hub."""
    tag: str
    """The revision of the repository that will name this content."""
    licence: Licence
    date: str
    """The day of publication, YYYY-MM-DD."""
    manifest: Manifest
    statistics: Mapping[str, Any]
    """What `scenegen.display.inspect.inspect` says of the dataset."""
    command: str
    """The command that makes the dataset again in a folder that holds ``recipe.toml``."""
    lock: str
    """Contents of the environment lock."""
    checks: tuple[tuple[str, str], ...]
    """Name and detail of every check that the dataset passed."""
    pictures: tuple[tuple[str, str], ...]
    """Name and caption of every picture."""
    page: str = ""
    """The name of the page to look at samples with; "" for none."""

    @property
    def name(self) -> str:
        """The name of the repository without its owner."""
        return self.repository.partition("/")[2]

    @property
    def url(self) -> str:
        """The address of the dataset's page on the Hub."""
        return f"https://huggingface.co/datasets/{self.repository}"

    @property
    def sentence(self) -> str:
        """What the dataset is, in one sentence."""
        kind = self.manifest.kind
        x, y, z = self.manifest.grid.shape
        voxel, mapping = self.manifest.grid.voxel_m, self.manifest.mapping
        made = "" if mapping.plain else f", each {mapping}"
        return (
            f"{self.statistics['samples']} pairs of a simulated LiDAR scan and the exact truth "
            f"around it, in "
            f"{KINDS.get(kind, f'worlds of kind {kind}')}, as {x} × {y} × {z} voxel maps of "
            f"{voxel:g} m{made}"
        )

    @property
    def splits(self) -> tuple[str, ...]:
        """Names of the splits that hold samples."""
        return tuple(name for name in SPLITS if name in self.statistics["splits"])

    @property
    def fields(self) -> dict[str, dict[str, Any]]:
        """What the shards store, in order: name to `dtype`, `shape`, `unit` and `meaning`."""
        known = self.manifest.schema.describe()
        stored = {name: known[name] for name in self.manifest.fields}
        return stored | {
            DIGEST: {
                "dtype": "uint8",
                "shape": (32,),
                "unit": "",
                "meaning": "the sample's own SHA-256 digest",
            }
        }
