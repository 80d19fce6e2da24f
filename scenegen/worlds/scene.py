"""Worlds from users' files: MJCF, meshes and maps, read with limits and made self-contained."""

import io
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from lidarsim.engines.voxels import FREE, VoxelMap
from lidarsim.grid import Floats, Ints
from lidarsim.parameters import MAX_TRIANGLES
from lidarsim.solids import HFIELD, MESH, PLANE, Solids, solids_of, visible_geoms
from scenegen.base.errors import CorruptFileError, DatasetError, SceneError, printable, reraise_as
from scenegen.base.limits import MAX_ASSET_BYTES, MAX_DOCUMENT_BYTES, MAX_GEOMS
from scenegen.base.paths import CLOUDS, MAPS, MESHES, WORLD_FILES
from scenegen.base.reading import read_bounded
from scenegen.worlds.cloud import Survey, map_clouds
from scenegen.worlds.drawing import flatten, memory_bytes
from scenegen.worlds.gltf import read_gltf
from scenegen.worlds.movers import with_text
from scenegen.worlds.place import (
    archived_place,
    encode_map,
    map_digest,
    named_map,
    place_of,
    read_place,
)
from scenegen.worlds.plan import read_plan
from scenegen.worlds.screen import screen
from scenegen.worlds.world import compile_world, geometry_digest, movers_of, quiet_mujoco

REPLICATE = re.compile(r"<(/?)replicate\b(?:[^>]*?\bcount\s*=\s*[\"'](\d+)[\"'])?[^>]*?(/?)>")
"""Its groups: a slash at an element's end, its count, and a slash if it is empty."""
INCLUDE = re.compile(r"<include\s+file\s*=\s*([\"'])(.*?)\1")
COMMENT = re.compile(r"<!--.*?(?:-->|\Z)", re.DOTALL)
PART = "<mujocoinclude"
"""Root of a file that only others include."""
MAX_SHIFT = 1e-6
"""Tolerance of a solid's place, metres, and as much again for each metre of the world's reach: the
precision of float32 vertices."""


@dataclass(frozen=True)
class Scene:
    """One file, made self-contained: an MJCF document, or a map of a real place."""

    name: str
    mjcf: bytes
    assets: Mapping[str, bytes]
    unseen: tuple[str, ...] = ()
    """Geoms that rays cannot see."""
    notes: tuple[str, ...] = ()
    """Parts that were left out, or read otherwise than one might expect: a sentence each."""
    geometry: bytes = b""
    """The `geometry_digest` of its solids."""

    @property
    def is_map(self) -> bool:
        """Whether it is a map of a real place."""
        return bool(named_map(self.mjcf))


@dataclass(frozen=True)
class Reading:
    """The result of reading one file."""

    path: Path
    outcome: Scene | SceneError | None
    """None: a part, which only other files include."""
    includes: frozenset[Path] = frozenset()
    """Files that it includes, resolved."""


def read_file(path: Path, *, materials: bool = False) -> Reading:
    """Read one file; see `load_scene`.

    Args:
        path: The file.
        materials: Whether the names of materials are kept.

    Returns:
        The reading; an error is an outcome, too.
    """
    includes: frozenset[Path] = frozenset()
    try:
        if path.suffix in (*MAPS, *CLOUDS):
            return Reading(path, load_map(path), includes)
        is_world = path.suffix in MESHES
        if not is_world:
            is_world, includes = look_over(path)
        return Reading(path, load_scene(path, materials=materials) if is_world else None, includes)
    except SceneError as error:
        return Reading(path, error, includes)


@reraise_as(SceneError, of=DatasetError)
def load_map(path: Path) -> Scene:
    """Read a map of a real place, or make one of a point cloud that says where its sensor was.
    Raises SceneError."""
    notes: tuple[str, ...] = ()
    if path.suffix in CLOUDS:
        plan = path.suffix == ".yaml"
        mapped = read_plan(path) if plan else map_clouds([path])
        place = place_of(encode_map(mapped.voxels, str(path)), ".npz", str(path))
        detail = f"walls are taken for {Survey.height_m:g} m high (map --height changes that)"
        if not plan:
            detail = f"{mapped.points} points become voxels of {mapped.voxels.voxel_m:g} m"
        moved = f"; {mapped.offset.tolist()} m are taken off their coordinates"
        notes = (f"{path.name}: {mapped.read}; {detail}{moved if mapped.offset.any() else ''}",)
    else:
        place = read_place(path)
    digest = map_digest(place.voxels)
    return Scene(path.name, place.mjcf, place.assets, notes=notes, geometry=digest)


def cut(scene: Scene, shares: Sequence[float], gap_m: float) -> list[Scene]:
    """Cut a map into regions, across its longer side.

    Args:
        scene: The map.
        shares: Relative volumes of the regions' free space.
        gap_m: Least distance between regions, metres.

    Returns:
        A map for each region, under the same name.

    Raises:
        SceneError: If nothing in a region is free.
    """
    voxels = archived_place(scene.mjcf, scene.assets, scene.name).voxels
    axis = int(voxels.states.shape[1] > voxels.states.shape[0])
    layers = np.moveaxis(voxels.states, axis, 0)
    free = np.cumsum([np.count_nonzero(layer == FREE) for layer in layers])
    ends = np.searchsorted(free, np.cumsum(shares) / sum(shares) * free[-1]) + 1
    gap, regions = math.ceil(gap_m / voxels.voxel_m), list[Scene]()
    for begin, end in zip([0, *ends[:-1] + gap], [*ends[:-1], len(layers)], strict=True):
        states = np.moveaxis(layers[begin:end], 0, axis)
        origin = voxels.origin + begin * voxels.voxel_m * np.eye(3)[axis]
        region = VoxelMap(np.ascontiguousarray(states), voxels.voxel_m, origin)
        place = place_of(encode_map(region, scene.name), ".npz", scene.name)
        regions.append(
            replace(scene, mjcf=place.mjcf, assets=place.assets, geometry=map_digest(region))
        )
    return regions


def load_scene(path: Path, *, materials: bool = False) -> Scene:
    """Read an MJCF file or a mesh and make it self-contained: only geoms, where MuJoCo puts them.

    The document is compiled again, and its solids compared with those of the file. MuJoCo may read
    other files, run long and allocate much memory: for files from strangers, call this in a process
    with limits.

    Args:
        path: The file.
        materials: Whether the names of materials are kept.

    Returns:
        The scene.

    Raises:
        SceneError: If it cannot serve as a world.
    """
    with quiet_mujoco() as warnings:
        drawn, notes = _compile(path)
        if any("NaN" in warning for warning in warnings):
            raise SceneError(f"{path}: has numbers that are NaN; give them values")
        data = mujoco.MjData(drawn)
        mujoco.mj_kinematics(drawn, data)
        with reraise_as(SceneError, f"{path}: "):
            expected = solids_of(drawn, data)
            mjcf, assets = flatten(drawn, data, materials=materials)  # names must be UTF-8
            if (movers := movers_of(drawn)) is not None:
                mjcf = with_text(mjcf, movers)
    with reraise_as(SceneError, of=CorruptFileError):  # readers of the dataset would refuse it
        screen(mjcf, assets, str(path))
    largest = max(map(len, assets.values()), default=0)
    if len(mjcf) > MAX_DOCUMENT_BYTES or largest > MAX_ASSET_BYTES:
        raise SceneError(
            f"{path}: made self-contained, {len(mjcf)} bytes and files of up to {largest}, "
            f"expected {MAX_DOCUMENT_BYTES} and {MAX_ASSET_BYTES} at most; use fewer geoms and "
            "coarser meshes"
        )
    world = compile_world(mjcf, assets, name=str(path))
    if not _agree(expected, world.solids):
        raise SceneError(
            f"{path}: made self-contained, its solids are not those that MuJoCo makes of it; "
            "simplify its meshes"
        )
    notes = [f"{path.name}: {note}" for note in (*notes, *_notes(drawn, expected))]
    return Scene(path.name, mjcf, assets, world.unseen, tuple(notes), geometry_digest(world.solids))


def _compile(path: Path) -> tuple[mujoco.MjModel, list[str]]:
    """Compile a file without the parts that only dress its geoms, and may need missing files.

    Returns the model, and notes on parts that were dropped and a user may look for. Raises
    SceneError."""
    is_mesh = path.suffix in MESHES
    problem = "a mesh that MuJoCo refuses" if is_mesh else "not valid MJCF"
    refused = (ValueError, OSError, MemoryError, RuntimeError, mujoco.FatalError)
    # MuJoCo calls a file of another type an MJCF file without a decoder
    hint = f"; expected {', '.join(WORLD_FILES)}, or a map, which scenegen map makes of points"
    end = hint * (path.suffix not in WORLD_FILES)
    with reraise_as(SceneError, f"{path}: {problem}: ", end, of=refused):
        notes: list[str] = []
        spec = mesh_spec(path, notes) if is_mesh else mujoco.MjSpec.from_file(str(path))
        if spec.skins:
            notes.append(
                f"skins ({len(spec.skins)}) are left out: they dress bodies, and rays do not see "
                "them"
            )
        if len(spec.geoms) > MAX_GEOMS:
            raise SceneError(f"{path}: more than {MAX_GEOMS} geoms; merge some into meshes")
        if spec.flexes:
            raise SceneError(f"{path}: has flexes, which rays do not see; use geoms instead")
        for material in spec.materials:
            material.textures = [""] * len(material.textures)
        for light in spec.lights:
            light.texture = ""
        # sensors may be of textures and skins; tuples that name these are no fault to MuJoCo
        for item in (*spec.sensors, *spec.skins, *spec.textures):
            spec.delete(item)
        spec.memory = memory_bytes(len(spec.geoms))
        # memory that no geom needs; MuJoCo would fill as much as is asked
        spec.nuserdata = spec.nkey = 0
        return spec.compile(), notes


def _agree(expected: Solids, compiled: Solids) -> bool:
    """Return whether the solids of the document are those that MuJoCo makes of the file."""
    for name in ("shape", "mesh_start", "mesh_filled"):
        if not np.array_equal(getattr(expected, name), getattr(compiled, name)):
            return False
    # float32 vertices are coarser far from the origin
    reach = max(np.abs(a).max(initial=0.0) for a in (expected.position, expected.triangles))
    # planes became infinite on purpose
    sized = expected.shape != PLANE
    return np.allclose(expected.size[sized], compiled.size[sized], 1e-12, 0.0) and all(
        np.abs(getattr(expected, name) - getattr(compiled, name)).max(initial=0.0)
        <= MAX_SHIFT * (1 + reach)
        for name in ("position", "rotation", "triangles")
    )


def _notes(model: mujoco.MjModel, solids: Solids) -> Iterator[str]:
    """Describe parts of the file that a user may miss in the world."""
    if model.njnt:
        yield f"joints ({model.njnt}) stay in their reference position: nothing moves"
    bent = visible_geoms(model) & np.isin(model.geom_type, (MESH, HFIELD))
    # height fields are closed always
    geoms = np.flatnonzero(bent)[~solids.mesh_filled]
    meshes = sorted({model.mesh(int(model.geom_dataid[geom])).name for geom in geoms})
    if meshes:
        yield (
            f"mesh {named(meshes)} is not closed, or its triangles disagree on what is outside: "
            "its surface is solid"
        )


def named(names: Sequence[str]) -> str:
    """List the first names, and count the rest."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def look_over(main: Path) -> tuple[bool, frozenset[Path]]:
    """Look through an MJCF file and the files that it includes, before MuJoCo reads them.

    Args:
        main: The file.

    Returns:
        Whether it is a world, and not a part of others; and the files that it includes, directly or
        by others, resolved.

    Raises:
        SceneError: If a file is not regular or too large, or multiplies geoms beyond the limit.
            MuJoCo reports other faults.
    """
    is_world, included, waiting = True, set[Path](), [main]
    while waiting:
        path = waiting.pop()
        with reraise_as(SceneError, of=DatasetError):
            text = read_bounded(path, MAX_DOCUMENT_BYTES).decode(errors="replace")
        text = COMMENT.sub(" ", text)
        if _repeats(text) > MAX_GEOMS:  # over many more, MuJoCo takes hours and gigabytes
            raise SceneError(f"{main}: more than {MAX_GEOMS} geoms; merge some into meshes")
        is_world &= not (path is main and PART in text)
        for _, name in INCLUDE.findall(text):
            # MuJoCo looks from the file that includes, or from the main one
            places = (folder / name for folder in (path.parent, main.parent))
            existing = {place.resolve() for place in places if place.exists()}
            waiting += existing - included
            included |= existing
    return is_world, frozenset(included)


def _repeats(text: str) -> float:
    """Return how often the nested <replicate>s of a file repeat the innermost element."""
    times, highest = [1.0], 1.0
    for ended, count, empty in REPLICATE.findall(text):
        if ended:
            times = times[:-1] or [1.0]
        elif not empty:
            times.append(times[-1] * (float(count) if count else 1.0))
            highest = max(highest, times[-1])
    return highest


UPRIGHT = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""From glTF, whose y points up, to z up; x stays."""


Placed = Iterator[tuple[str, Floats, Ints]]
"""Name, corners (n, 3), metres, z up, and triangles (m, 3) of each object of a mesh file."""


def _objects(path: Path, notes: list[str]) -> Placed:
    """Read the objects of a mesh file, and note unread parts. Raises SceneError."""
    with reraise_as(SceneError, of=DatasetError):
        content = read_bounded(path, MAX_ASSET_BYTES)
    # readers of damaged files raise anything, and numpy warns of numbers that are refused later
    with (
        reraise_as(SceneError, f"{path}: cannot be read as {path.suffix}: ", of=Exception),
        np.errstate(all="ignore"),
    ):
        yield from _gltf(content, notes) if path.suffix == ".glb" else _by_trimesh(path, content)


def _gltf(content: bytes, notes: list[str]) -> Placed:
    """Read the objects of a .glb; see `_objects`."""
    # a damaged file may break any look-up in its JSON
    message = "its parts do not fit together: ", "; export it again"
    with reraise_as(
        CorruptFileError, *message, of=(LookupError, TypeError, ValueError, AttributeError)
    ):
        file = read_gltf(content)
        notes += file.notes()
        for name, corners, faces in file.objects():
            yield name, corners @ UPRIGHT[:3, :3].T, faces


def _by_trimesh(path: Path, content: bytes) -> Placed:
    """Read the objects of another mesh file; see `_objects`."""
    import trimesh  # takes a second to load

    scene = trimesh.load(  # without a resolver, no other file is read
        io.BytesIO(content),
        file_type=path.suffix[1:],
        force="scene",
        process=False,
        skip_materials=True,
        split_objects=True,
    )
    for mesh in scene.dump():
        if isinstance(mesh, trimesh.Trimesh):
            yield mesh.metadata.get("name", ""), mesh.vertices, mesh.faces


def mesh_spec(path: Path, notes: list[str]) -> mujoco.MjSpec:
    """Make the MJCF of a mesh file: a geom for each of its objects, where they stand.

    A .glb is in metres with y up, by glTF 2.0; the others do not say, and count as in metres with z
    up. Colours are ignored.

    Args:
        path: The file.
        notes: Gets a sentence for each unread part.

    Returns:
        The MJCF, not compiled.

    Raises:
        SceneError: If the file is damaged or too large, or holds no triangles.
    """
    spec, triangles = mujoco.MjSpec(), 0
    for name, corners, faces in _objects(path, notes):
        if not len(faces):
            continue
        triangles += len(faces)
        if triangles > MAX_TRIANGLES or len(spec.geoms) >= MAX_GEOMS:
            raise SceneError(
                f"{path}: more than {MAX_TRIANGLES} triangles or {MAX_GEOMS} objects; simplify it"
            )
        complete = faces.min() >= 0 and faces.max() < len(corners)
        if not complete or not np.isfinite(corners).all():
            raise SceneError(
                f"{path}: has corners that are not finite, or that are missing; export it again"
            )
        if len(corners) == 3:  # MuJoCo wants four
            corners = corners[[0, 1, 2, 2]]
        label = f"{len(spec.geoms)} {printable(name)[:60]}"
        spec.add_mesh(
            name=label,
            uservert=corners.reshape(-1),
            userface=faces.reshape(-1),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )
        spec.worldbody.add_geom(
            name=label,
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=label,
            contype=0,
            conaffinity=0,
        )
    if not triangles:
        raise SceneError(f"{path}: holds no triangles; for points alone see scenegen map")
    return spec
