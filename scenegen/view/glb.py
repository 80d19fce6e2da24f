"""A world as a GLB file, glTF 2.0 in one piece: a mesh for each solid, in its geom's colour."""

from itertools import pairwise
from typing import Any

import numpy as np
import trimesh

from lidarsim.grid import Floats
from lidarsim.solids import BOX, CAPSULE, CYLINDER, ELLIPSOID, PLANE, SPHERE
from scenegen.worlds.scene import UPRIGHT
from scenegen.worlds.world import World

SIDES = 32
"""Sides of round solids around their axis."""
THICK_M = 0.01
"""Depth of a plane below its surface, metres; viewers hide the back of a flat one."""


def encode_world(world: World) -> bytes:
    """Return a world as the content of a GLB file. Vertices of round solids lie on the true
    surface; planes, which are infinite, end beyond the flight bounds."""
    scene = trimesh.Scene()
    # MuJoCo has channels from 0 to 1, trimesh bytes
    colours = (255 * world.model.geom_rgba).astype(np.uint8)
    for n, (mesh, geom) in enumerate(zip(surfaces(world), world.solids.geom, strict=True)):
        mesh.visual.face_colors = colours[geom]
        # glTF has y upwards
        scene.add_geometry(
            mesh, node_name=f"solid {n}", geom_name=f"solid {n}", transform=UPRIGHT.T
        )
    return bytes(scene.export(file_type="glb"))


def surfaces(world: World) -> list[Any]:
    """Return a trimesh for each solid of a world, in the world's frame, metres."""
    solids = world.solids
    reach = 2 * float(np.abs(world.flight_bounds).max())  # of a plane, which has no end
    meshes: list[Any] = []
    for shape, size, position, rotation in zip(
        solids.shape, solids.size, solids.position, solids.rotation, strict=True
    ):
        frame = np.eye(4)
        frame[:3, :3], frame[:3, 3] = rotation, position
        meshes.append(_surface(int(shape), size, reach).apply_transform(frame))
    for first, last in pairwise(solids.mesh_start):
        corners = solids.triangles[first:last].reshape(-1, 3)
        faces = np.arange(len(corners)).reshape(-1, 3)
        meshes.append(trimesh.Trimesh(corners, faces, process=False))
    return meshes


def _surface(shape: int, size: Floats, reach: float) -> Any:
    """Return the mesh of a solid around its centre, from MuJoCo's sizes."""
    make = trimesh.creation
    if shape == PLANE:
        lid = make.box((2 * reach, 2 * reach, THICK_M))
        return lid.apply_translation((0, 0, -THICK_M / 2))
    if shape == BOX:
        return make.box(2 * size)  # MuJoCo's sizes are half lengths
    if shape == CYLINDER:
        return make.cylinder(size[0], 2 * size[1], sections=SIDES)
    if shape == CAPSULE:
        mesh = make.capsule(2 * size[1], size[0], count=(SIDES, SIDES // 2))
        return mesh.apply_translation(-mesh.bounds.mean(axis=0))  # versions place it differently
    assert shape in (SPHERE, ELLIPSOID)
    radii = size[[0, 0, 0]] if shape == SPHERE else size
    return make.uv_sphere(1.0, count=(SIDES // 2, SIDES)).apply_scale(radii)
