"""Meshes as worlds: each object of a .glb, .obj or .stl file becomes a geom, by trimesh."""

import io
from pathlib import Path

import mujoco
import numpy as np

from lidarsim.parameters import MOST_TRIANGLES
from scenegen.errors import DatasetError, SceneError, printable
from scenegen.files import read_bounded
from scenegen.limits import MOST_ASSET_BYTES, MOST_GEOMS

UPRIGHT = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""From glTF, whose y points up, to z up; x stays."""


def mesh_spec(path: Path) -> mujoco.MjSpec:
    """The MJCF of a mesh file: a geom for each of its objects, where they stand.

    A .glb is in metres with y up, as glTF 2.0 says; the others say neither, and are taken to be in
    metres with z up. Colours are left out. Raises SceneError.
    """
    import trimesh  # takes a second to load

    try:
        content = read_bounded(path, MOST_ASSET_BYTES)
    except (DatasetError, FileNotFoundError) as error:
        raise SceneError(str(error)) from None
    try:
        scene = trimesh.load(  # without a resolver, no other file is read
            io.BytesIO(content),
            file_type=path.suffix[1:],
            force="scene",
            process=False,
            skip_materials=True,
            split_objects=True,
        )
        if path.suffix == ".glb":
            scene.apply_transform(UPRIGHT)
        placed = scene.dump()
    except Exception as error:  # trimesh's loaders raise anything
        raise SceneError(
            f"{path}: cannot be read as {path.suffix}: {printable(error)[:200]}"
        ) from None
    spec, triangles = mujoco.MjSpec(), 0
    for mesh in placed:
        if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
            continue
        triangles, corners = triangles + len(mesh.faces), mesh.vertices
        if triangles > MOST_TRIANGLES or len(spec.geoms) >= MOST_GEOMS:
            raise SceneError(
                f"{path}: more than {MOST_TRIANGLES} triangles or {MOST_GEOMS} objects; simplify it"
            )
        there = mesh.faces.min() >= 0 and mesh.faces.max() < len(corners)
        if not there or not np.isfinite(corners).all():
            raise SceneError(
                f"{path}: has corners that are not finite, or that are missing; export it again"
            )
        if len(corners) == 3:  # MuJoCo wants four
            corners = corners[[0, 1, 2, 2]]
        called = f"{len(spec.geoms)} {printable(mesh.metadata.get('name', ''))[:60]}"
        spec.add_mesh(
            name=called,
            uservert=corners.reshape(-1),
            userface=mesh.faces.reshape(-1),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )
        spec.worldbody.add_geom(
            name=called,
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=called,
            contype=0,
            conaffinity=0,
        )
    if not triangles:
        raise SceneError(f"{path}: holds no triangles; for points alone see scenegen map")
    return spec
