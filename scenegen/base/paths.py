"""Recognise what a path is (a dataset, a log, a scan, a map, a world, predictions, a run …), and
open it.

    what_is("campus.bt")  # "map"
    open_path("campus.bt")  # the map, as a world

Names, files in a folder and first bytes tell. Functions that open things stand in rooms above this
one; they are named here as ``module:function``, and imported when they are asked for.
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
from scenegen.base.limits import MOST_MANIFEST_BYTES

MAPS = (".bt", ".ot", ".npz")
"""Endings of maps of real places; an .npz file may be a scan, too."""
MESHES = (".obj", ".glb", ".stl")
"""Endings of meshes, which are worlds of their own."""
SCANS = (".ply", ".pcd", ".las", ".laz", ".xyz", ".npy", ".npz", ".bin")
"""Endings of point clouds; `scenegen.worlds.clouds.READERS` reads them."""
CLOUDS = (*SCANS[:-2], ".yaml")
"""Endings of clouds, and of ROS's plans, from which maps are made where a world is expected; an
.npz file is taken for a map there."""
WORLD_FILES = (".xml", *MAPS, *CLOUDS, *MESHES)
"""Endings of all files that are worlds."""
RECORDINGS = (".mcap", ".bag", ".db3")
"""Endings of recordings of ROS."""
MAX_LISTED = 10_000
"""Files of a folder among which scans are looked for."""
MAX_HEAD_BYTES = 256

Test = Callable[[Path], bool]


@dataclass(frozen=True, kw_only=True)
class PathType:
    """One type of thing that a path may be."""

    form: str
    """How it is recognised, for people: "a folder with dataset.json"."""
    test: Test
    opens: str
    """``module:function`` that opens a path of this type."""
    facts: str = ""
    """``module:function`` that gives what `scenegen inspect` says of it, as JSON values."""
    draws: str = ""
    """``module:function`` that draws it, as a matplotlib figure."""
    shows: str = ""
    """``module:function`` that gives some of its samples, as `scenegen.view.look.Look`."""


def ends(*endings: str) -> Test:
    """A test for files by the ends of their names."""
    return lambda path: path.name.lower().endswith(endings) and not path.is_dir()


def holds(*patterns: str) -> Test:
    """A test for folders that hold a file of one of these names or patterns."""
    return lambda path: any(any(path.glob(pattern)) for pattern in patterns)


def begins(ending: str, pattern: str) -> Test:
    """A test for files by the end of their names and their first bytes."""

    def test(path: Path) -> bool:
        if not (path.suffix == ending and path.is_file()):  # a pipe would never end
            return False
        with open(path, "rb") as file:
            return re.match(pattern.encode(), file.read(MAX_HEAD_BYTES)) is not None

    return test


def names(ending: str, word: str) -> Test:
    """A test for files by the end of their names and a string of JSON that they hold, anywhere:
    other programs write keys in another order."""

    def test(path: Path) -> bool:
        is_read = path.suffix == ending and path.is_file()  # a pipe would never end
        is_read = is_read and path.stat().st_size <= MOST_MANIFEST_BYTES
        return is_read and f'"{word}"'.encode() in path.read_bytes()

    return test


def is_map(path: Path) -> bool:
    """Whether a file is a map of a real place: by its name, and an .npz file, which may be a scan,
    by what it holds."""
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
    """Whether there is a log with poses of its own at `path`: a recording, or a folder of one, or
    of clouds with poses."""
    if not path.is_dir():
        return ends(*RECORDINGS)(path)
    has_poses = holds("metadata.yaml", "poses.txt")(path) or kitti_poses(path).exists()
    return has_poses or bool(recordings_in(path))


def kitti_poses(sequence: Path) -> Path:
    """Where KITTI's own archives have the poses of a sequence."""
    return sequence.parent.parent / "poses" / f"{sequence.name}.txt"


def recordings_in(folder: Path) -> list[Path]:
    """The recordings in a folder that holds no clouds."""
    recordings = sorted(file for file in folder.iterdir() if file.suffix in RECORDINGS)
    return [] if recordings and holds_scans(folder) else recordings


def holds_scans(folder: Path) -> bool:
    """Whether clouds lie in a folder or below it."""
    return folder.is_dir() and any(map(ends(*SCANS), islice(folder.rglob("*"), MAX_LISTED)))


_WORLD: dict[str, Any] = {
    "opens": "scenegen.draw.source:read_world",
    "facts": "scenegen.view.inspect:inspect_world",
    "draws": "scenegen.view.pictures:draw_world_file",
}
TYPES = {
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
        form="an .h5 file, or a folder with predictions.json",
        test=lambda path: ends(".h5")(path) or holds("predictions.json")(path),
        opens="scenegen.model.bench.methods:Predicted",
        facts="scenegen.model.completion.stored:prediction_facts",
        draws="scenegen.model.completion.scans:draw_completion",
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
    ),
    "scans": PathType(
        form="a folder with scans in it",
        test=holds_scans,
        opens="scenegen.worlds.clouds:scans_in",
    ),
    "map": PathType(
        form="a .bt or .ot file, or an .npz file of `scenegen map`",
        test=is_map,
        opens="scenegen.draw.source:read_world",
        facts="scenegen.view.inspect:inspect_world",
    ),
    "scan": PathType(
        form=f"a file that ends in {', '.join(SCANS)}",
        test=ends(*SCANS),
        opens="scenegen.worlds.clouds:read_cloud",
        facts="scenegen.view.inspect:scan_facts",
        draws="scenegen.view.pictures:draw_scan",
    ),
    "world": PathType(form="an MJCF file, .xml", test=ends(".xml"), **_WORLD),
    "mesh": PathType(form=f"a file that ends in {', '.join(MESHES)}", test=ends(*MESHES), **_WORLD),
    "plan": PathType(
        form="a floor plan of ROS, .yaml",
        test=ends(".yaml"),
        opens="scenegen.draw.source:read_world",
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
    ),
    "recipe": PathType(
        form="a .toml file", test=ends(".toml"), opens="scenegen.worlds.recipe:read_recipe"
    ),
}
"""Every type of path by its name; of several that fit, the first holds."""
DATA = ("dataset", "collection", "selection", "datasets")
"""Types that are read by split: see `scenegen.dataset.collection.open_data`."""


def type_of(path: str | PurePath) -> str | None:
    """The name of a path's type, of `TYPES`; None for a path that is of none. A name with a scheme,
    such as s3://bucket/folder, is a dataset."""
    if not isinstance(path, Path):
        if "://" in str(path):
            return "dataset"
        path = Path(path)
    return next((name for name, path_type in TYPES.items() if path_type.test(path)), None)


def what_is(path: str | PurePath) -> str:
    """The name of a path's type, as `type_of`. Raises DatasetError for a path that is of none."""
    if name := type_of(path):
        return name
    there = Path(path)
    if not there.exists():
        siblings = [sibling.name for sibling in there.parent.glob("*")]
        near = difflib.get_close_matches(there.name, siblings, 1)
        hint = f"; did you mean {there.with_name(near[0])}?" if near else ""
        raise DatasetError(f"{path}: there is no such file or folder{hint}")
    seen = f"a file that ends in {there.suffix or 'nothing known'}"
    if there.is_dir():
        seen = "a folder that holds none of these"
    known = "; ".join(f"{name} ({path_type.form})" for name, path_type in TYPES.items())
    raise DatasetError(f"{path}: {seen}; known are {known}")


def check_type(path: str | PurePath, *expected: str) -> None:
    """Raise DatasetError for a path that is recognised as of another type than those `expected`,
    and for a file of no type; a folder may be damaged, which whoever opens it says."""
    name = type_of(path)
    if name is None and Path(path).is_file():
        what_is(path)
    if name is not None and name not in expected:
        inner = sorted(Path(path).glob("*/dataset.json")) if name == "datasets" else []
        hint = f"; did you mean {inner[0].parent}?" if "dataset" in expected and inner else ""
        hint = f"expected {' or '.join(expected)}{hint}"
        raise DatasetError(f"{path}: is of type {name} ({TYPES[name].form}), {hint}")


def function_for(path: str | PurePath, verb: Literal["opens", "facts", "draws", "shows"]) -> Any:
    """The function that has a `verb` of `PathType` done to a path. Raises DatasetError for a path
    of no type, or of one without such a function."""
    name = what_is(path)
    functions = {other: place for other in TYPES if (place := getattr(TYPES[other], verb))}
    check_type(path, *dict.fromkeys(("dataset", *functions)))  # which all commands take
    return Registry("type of path", functions).find(name)


def open_path(path: str | PurePath) -> Any:
    """Open a path by the function of its type. Raises DatasetError for a path of no type, and as
    that function does."""
    return function_for(path, "opens")(path)
