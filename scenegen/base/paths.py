"""Recognise the type of a path (a dataset, a log, a scan, a map, a world, predictions, a run …),
and open it.

    what_is("campus.bt")  # "map"
    open_path("campus.bt")  # the map, as a world

Types are recognised by names, by files in a folder, and by first bytes. The functions that open
them belong to rooms above this one; they are named as ``module:function`` and imported on use.
"""

import difflib
import re
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path, PurePath
from typing import Any, Literal

from lidarsim.registry import Registry
from scenegen.base.errors import DatasetError
from scenegen.base.limits import MAX_MANIFEST_BYTES

MAPS = (".bt", ".ot", ".npz")
"""Endings of maps of real places. An .npz file may also be a scan."""
MESHES = (".obj", ".glb", ".stl")
"""Endings of meshes, each of which is a world."""
SCANS = (".ply", ".pcd", ".las", ".laz", ".xyz", ".npy", ".npz", ".bin")
"""Endings of point clouds, for the readers in `scenegen.worlds.clouds.READERS`."""
CLOUDS = (*SCANS[:-2], ".yaml")
"""Endings of point clouds and ROS floor plans that are converted to maps where a world is expected.
An .npz file counts as a map there."""
WORLD_FILES = (".xml", *MAPS, *CLOUDS, *MESHES)
"""Endings of all files that can be worlds."""
RECORDINGS = (".mcap", ".bag", ".db3")
"""Endings of ROS recordings."""
MAX_LISTED = 10_000
"""Maximum number of files that are examined in search of scans in a folder."""
MAX_HEAD_BYTES = 256
"""Length of the part of a file that types are recognised by, bytes."""

Test = Callable[[Path], bool]


@dataclass(frozen=True, kw_only=True)
class PathType:
    """One type of path."""

    form: str
    """How it is recognised, for messages: "a folder with dataset.json"."""
    test: Test
    opens: str
    """``module:function`` that opens a path of this type."""
    facts: str = ""
    """``module:function`` that returns the facts for `scenegen inspect`, as JSON values."""
    draws: str = ""
    """``module:function`` that draws it as a matplotlib figure."""
    shows: str = ""
    """``module:function`` that returns some of its samples as `scenegen.view.look.Look`."""
    film: bool = False
    """Whether these samples follow one another in time."""


def ends(*endings: str) -> Test:
    """Make a test for files by the endings of their names."""
    return lambda path: path.name.lower().endswith(endings) and not path.is_dir()


def holds(*patterns: str) -> Test:
    """Make a test for folders by names or patterns of files in them."""
    return lambda path: any(any(path.glob(pattern)) for pattern in patterns)


def begins(ending: str, pattern: str) -> Test:
    """Make a test for files by their ending and their first bytes.

    Args:
        ending: The ending, such as ".json".
        pattern: Regular expression that the first `MAX_HEAD_BYTES` must match.
    """

    def test(path: Path) -> bool:
        if not (path.suffix == ending and path.is_file()):  # a pipe would never end
            return False
        with open(path, "rb") as file:
            return re.match(pattern.encode(), file.read(MAX_HEAD_BYTES)) is not None

    return test


def names(ending: str, word: str) -> Test:
    """Make a test for files by their ending and a string of JSON anywhere in them.

    A test of the first bytes would not do, since other programs write keys in another order.

    Args:
        ending: The ending, such as ".json".
        word: The string, without quotes.
    """

    def test(path: Path) -> bool:
        is_read = path.suffix == ending and path.is_file()  # a pipe would never end
        is_read = is_read and path.stat().st_size <= MAX_MANIFEST_BYTES
        return is_read and f'"{word}"'.encode() in path.read_bytes()

    return test


def is_map(path: Path) -> bool:
    """Whether a file is a map of a real place. An .npz file may also be a scan, so its members
    decide."""
    if path.suffix != ".npz":
        return ends(*MAPS)(path)
    if not path.is_file():
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return "states.npy" in archive.namelist()
    except (OSError, zipfile.BadZipFile):
        return False


def is_log(path: Path) -> bool:
    """Whether a path is a log with poses: a recording, a folder of one, or a folder of clouds with
    poses."""
    if not path.is_dir():
        return ends(*RECORDINGS)(path)
    has_poses = holds("metadata.yaml", "poses.txt")(path) or kitti_poses(path).exists()
    return has_poses or bool(recordings_in(path))


def kitti_poses(sequence: Path) -> Path:
    """Path of the poses of a sequence in KITTI's folder structure."""
    return sequence.parent.parent / "poses" / f"{sequence.name}.txt"


def recordings_in(folder: Path) -> list[Path]:
    """Recordings in a folder; none if it holds point clouds."""
    recordings = sorted(file for file in folder.iterdir() if file.suffix in RECORDINGS)
    return [] if recordings and holds_scans(folder) else recordings


def holds_scans(folder: Path) -> bool:
    """Whether a folder or its subfolders contain point clouds."""
    return folder.is_dir() and any(map(ends(*SCANS), islice(folder.rglob("*"), MAX_LISTED)))


_WORLD: dict[str, Any] = {
    "opens": "scenegen.draw.source:read_world",
    "facts": "scenegen.view.inspect:inspect_world",
    "shows": "scenegen.view.opened:looks_of_world",
}
TYPES = {
    # order matters: a collection's folder, for example, would also pass as "datasets"
    "collection": PathType(
        form="a folder with collection.json",
        test=holds("collection.json"),
        opens="scenegen.dataset.collection:open_data",
        facts="scenegen.view.inspect:inspect_path",
        shows="scenegen.view.look:looks_of_dataset",
    ),
    "selection": PathType(
        form="a .json file of `scenegen take`",
        test=names(".json", "scenegen-selection"),
        opens="scenegen.dataset.collection:open_data",
        facts="scenegen.view.inspect:inspect_path",
        shows="scenegen.view.look:looks_of_dataset",
    ),
    "dataset": PathType(
        form="a folder with dataset.json",
        test=holds("dataset.json"),
        opens="scenegen.dataset.collection:open_data",
        facts="scenegen.view.inspect:inspect_path",
        shows="scenegen.view.look:looks_of_dataset",
    ),
    "predictions": PathType(
        form="an .h5 file, or a folder with predictions.json or completions.json",
        test=lambda path: ends(".h5")(path) or holds("predictions.json", "completions.json")(path),
        opens="scenegen.model.bench.methods:Predicted",
        facts="scenegen.model.completion.stored:prediction_facts",
        shows="scenegen.model.completion.scans:looks_of_completion",
    ),
    "run": PathType(
        form="a folder with metrics.csv",
        test=holds("metrics.csv"),
        opens="scenegen.model.training.run_folder:RunFolder",
        facts="scenegen.model.training.run_folder:run_facts",
        draws="scenegen.model.training.card:draw_run",
    ),
    "datasets": PathType(
        form="a folder of datasets",
        test=holds("*/dataset.json"),
        opens="scenegen.dataset.collection:open_data",
        facts="scenegen.view.inspect:inspect_all",
    ),
    "log": PathType(
        form=f"a file that ends in {', '.join(RECORDINGS)}, or a folder with poses.txt",
        test=is_log,
        opens="scenegen.logs.read:read_log",
        shows="scenegen.view.opened:looks_of_log",
        film=True,
    ),
    "scans": PathType(
        form="a folder with scans in it",
        test=holds_scans,
        opens="scenegen.worlds.clouds:scans_in",
        shows="scenegen.view.opened:looks_of_scans",
        film=True,
    ),
    "map": PathType(
        form="a .bt or .ot file, or an .npz file of `scenegen map`",
        test=is_map,
        opens="scenegen.draw.source:read_world",
        facts="scenegen.view.inspect:inspect_world",
        shows="scenegen.view.opened:looks_of_world",
    ),
    "scan": PathType(
        form=f"a file that ends in {', '.join(SCANS)}",
        test=ends(*SCANS),
        opens="scenegen.worlds.clouds:read_cloud",
        facts="scenegen.view.inspect:scan_facts",
        shows="scenegen.view.opened:looks_of_scan",
    ),
    "world": PathType(form="an MJCF file, .xml", test=ends(".xml"), **_WORLD),
    "mesh": PathType(form=f"a file that ends in {', '.join(MESHES)}", test=ends(*MESHES), **_WORLD),
    "plan": PathType(
        form="a floor plan of ROS, .yaml",
        test=ends(".yaml"),
        opens="scenegen.draw.source:read_world",
        shows="scenegen.view.opened:looks_of_world",
    ),
    "weights": PathType(
        form="a .safetensors or .onnx file",
        test=ends(".safetensors", ".onnx"),
        opens="scenegen.model.completion.completer:open_network",
    ),
    "flights": PathType(
        form="a .json file of `scenegen fly -o`",
        test=begins(".json", r'\s*\{\s*"format":\s*\d+,\s*"scenegen":'),
        opens="scenegen.fly.course:read_recording",
        shows="scenegen.model.robots.film:looks_of_recording",
        film=True,
    ),
    "recipe": PathType(
        form="a .toml file", test=ends(".toml"), opens="scenegen.worlds.recipe:read_recipe"
    ),
}
"""All types by name. The first that fits a path holds."""
DATA = ("dataset", "collection", "selection", "datasets")
"""Types that are read by split; see `scenegen.dataset.collection.open_data`."""


def type_of(path: str | PurePath) -> str | None:
    """Name of a path's type in `TYPES`, or None. A name with a scheme, such as s3://bucket/folder,
    is a dataset."""
    # a Path makes one slash of two, so only text can be a URL
    if not isinstance(path, Path):
        if "://" in str(path):
            return "dataset"
        path = Path(path)
    return next((name for name, path_type in TYPES.items() if path_type.test(path)), None)


def what_is(path: str | PurePath) -> str:
    """Name of a path's type in `TYPES`.

    Raises:
        DatasetError: if nothing is at the path, or it has no known type.
    """
    if name := type_of(path):
        return name
    location = Path(path)
    if not location.exists():
        siblings = [sibling.name for sibling in location.parent.glob("*")]
        near = difflib.get_close_matches(location.name, siblings, 1)
        hint = f"; did you mean {location.with_name(near[0])}?" if near else ""
        raise DatasetError(f"{path}: there is no such file or folder{hint}")
    seen = f"a file that ends in {location.suffix or 'nothing known'}"
    if location.is_dir():
        seen = "a folder that holds none of these"
    known = "; ".join(f"{name} ({path_type.form})" for name, path_type in TYPES.items())
    raise DatasetError(f"{path}: {seen}; known are {known}")


def check_type(path: str | PurePath, *expected: str) -> None:
    """Check that a path has one of several types.

    Args:
        path: The path.
        expected: Names of allowed types.

    Raises:
        DatasetError: if it has another type, or is a file without type. A folder without type
            passes: it may be a damaged dataset, which its reader explains.
    """
    name = type_of(path)
    if name is None and Path(path).is_file():
        # raises the error, with all types that are known
        what_is(path)
    if name is not None and name not in expected:
        # a common mistake: the folder above the dataset
        inner = sorted(Path(path).glob("*/dataset.json")) if name == "datasets" else []
        hint = f"; did you mean {inner[0].parent}?" if "dataset" in expected and inner else ""
        hint = f"expected {' or '.join(expected)}{hint}"
        raise DatasetError(f"{path}: is of type {name} ({TYPES[name].form}), {hint}")


def function_for(path: str | PurePath, verb: Literal["opens", "facts", "draws", "shows"]) -> Any:
    """Import the function for a path's type.

    Args:
        path: The path.
        verb: Field of `PathType` that names the function.

    Raises:
        DatasetError: if the path has no type, or its type has no such function.
    """
    name = what_is(path)
    targets = {
        type_name: target for type_name in TYPES if (target := getattr(TYPES[type_name], verb))
    }
    # datasets come first in the message: every command accepts them
    check_type(path, *dict.fromkeys(("dataset", *targets)))
    return Registry("type of path", targets).find(name)


def open_path(path: str | PurePath) -> Any:
    """Open a path with the function of its type.

    Raises:
        DatasetError: if the path has no type. Errors of the function pass through.
    """
    return function_for(path, "opens")(path)
