"""A world as a GLB file, glTF 2.0 in one piece: a mesh for each solid, in its geom's colour."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from lidarsim.solids.shapes import BOX, CAPSULE, CYLINDER, ELLIPSOID, PLANE, SPHERE
from scenegen.worlds.world import World

SIDES = 32
"""How many sides round solids have around their axis."""
UPRIGHT = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""glTF's y is up; x stays."""
THICK_M = 0.01
"""How far a plane goes down, metres: it has no thickness of its own."""


def encode_world(world: World) -> bytes:
    """The content of the file. Corners of round solids lie on them; planes end at the flight's
    box."""
    scene = trimesh.Scene()
    colours = (255 * world.model.geom_rgba).astype(np.uint8)
    for n, (mesh, geom) in enumerate(zip(surfaces(world), world.solids.geom, strict=True)):
        mesh.visual.face_colors = colours[geom]
        scene.add_geometry(mesh, node_name=f"solid {n}", geom_name=f"solid {n}", transform=UPRIGHT)
    return bytes(scene.export(file_type="glb"))


def surfaces(world: World) -> list[Any]:
    """A mesh for each solid, world frame, metres."""
    solids = world.solids
    meshes: list[Any] = []
    for shape, size, position, rotation in zip(
        solids.shape, solids.size, solids.position, solids.rotation, strict=True
    ):
        mesh = _plane(world) if shape == PLANE else SURFACES[int(shape)](size)
        frame = np.eye(4)
        frame[:3, :3], frame[:3, 3] = rotation, position
        meshes.append(mesh.apply_transform(frame))
    for first, last in pairwise(solids.mesh_start):
        corners = solids.triangles[first:last].reshape(-1, 3)
        meshes.append(
            trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)
        )
    return meshes


def _plane(world: World) -> Any:
    """A thin box below z = 0 as wide as the flight's box and its distance from the middle."""
    reach = 2 * float(np.abs(world.flight_bounds).max())
    return trimesh.creation.box((2 * reach, 2 * reach, THICK_M)).apply_translation(
        (0, 0, -THICK_M / 2)
    )


def _ellipsoid(size: NDArray[np.float64]) -> Any:
    return trimesh.creation.uv_sphere(1.0, count=(SIDES // 2, SIDES)).apply_scale(size)


def _capsule(size: NDArray[np.float64]) -> Any:
    mesh = trimesh.creation.capsule(2 * size[1], size[0], count=(SIDES, SIDES // 2))
    return mesh.apply_translation(
        -mesh.bounds.mean(axis=0)
    )  # versions of trimesh place it differently


SURFACES: dict[int, Callable[[NDArray[np.float64]], Any]] = {
    SPHERE: lambda size: _ellipsoid(np.repeat(size[:1], 3)),
    ELLIPSOID: _ellipsoid,
    BOX: lambda size: trimesh.creation.box(2 * size),
    CYLINDER: lambda size: trimesh.creation.cylinder(size[0], 2 * size[1], sections=SIDES),
    CAPSULE: _capsule,
}
"""A shape's surface around its middle, from MuJoCo's sizes."""
