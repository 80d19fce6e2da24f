"""Draw the pictures of docs/worlds.md: a world of each kind with its flight.

python docs/pictures.py [KIND…]  needs `pip install pyvista`; writes docs/pictures/*.png
"""

import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyvista as pv

from lidarsim.solids import BOX, CAPSULE, CYLINDER, ELLIPSOID, HFIELD, Solids
from scenegen.draw.draw import Unit, draw_unit
from scenegen.draw.source import DrawnWorlds
from scenegen.worlds.kinds import kind_names
from scenegen.worlds.recipe import Recipe, preset
from scenegen.worlds.world import solid

OUT = Path(__file__).parent / "pictures"


def main() -> None:
    """Draw everything."""
    OUT.mkdir(exist_ok=True)
    for kind in sys.argv[1:] or kind_names():
        recipe = preset(kind)
        unit = draw_unit(DrawnWorlds(recipe), recipe, seed=0, split="train", unit=1)
        draw_world(unit, recipe, OUT / f"{kind}.png")


def draw_world(unit: Unit, recipe: Recipe, path: Path) -> None:
    """The solids of a world, the viewpoints of its flight, and the map's box around one of them."""
    plotter = pv.Plotter(off_screen=True, window_size=[900, 580])
    world = solid(unit.world, "drawn")
    model, solids = world.model, world.solids
    worn = model.geom_matid >= 0
    colours = model.geom_rgba.copy()
    colours[worn] = model.mat_rgba[model.geom_matid[worn]]
    for geom, mesh in zip(solids.geom, solid_meshes(solids), strict=True):
        above = model.geom_matid[geom] >= 0 and model.mat(model.geom_matid[geom]).name == "ceiling"
        roof = world.data.geom_xmat[geom, 8] < 0 and model.geom_type[geom] == HFIELD
        if not (above or roof):  # which would hide what is below
            plotter.add_mesh(mesh, color=np.sqrt(colours[geom, :3]), smooth_shading=False)
    for sample in unit.samples:
        plotter.add_mesh(pv.Sphere(radius=0.35, center=sample.position), color="crimson")
    sample = unit.samples[2]
    corner = sample.origin + recipe.grid.extent_m
    box = pv.Box(np.stack([sample.origin, corner], 1).ravel())
    plotter.add_mesh(box, style="wireframe", color="crimson", line_width=3)
    plotter.camera_position = [(62, -22, 42), (20, 19, 1), (0, 0, 1)]
    plotter.enable_lightkit()
    plotter.screenshot(path)
    plotter.close()


def solid_meshes(solids: Solids) -> list[Any]:
    """A surface for every solid, primitives first."""
    meshes = []
    for shape, size, position, rotation in zip(
        solids.shape, solids.size, solids.position, solids.rotation, strict=True
    ):
        mesh = surface(int(shape), size)
        frame = np.eye(4)
        frame[:3, :3], frame[:3, 3] = rotation, position
        meshes.append(mesh.transform(frame, inplace=False))
    for begin, end in pairwise(solids.mesh_start.tolist()):
        corners = solids.triangles[begin:end].reshape(-1, 3)
        faces = np.insert(np.arange(len(corners)).reshape(-1, 3), 0, 3, axis=1)
        meshes.append(pv.PolyData(corners, faces))
    return meshes


def surface(shape: int, size: np.ndarray) -> Any:
    """The surface of a primitive in its own frame."""
    if shape == BOX:
        return pv.Box(np.stack([-size, size], 1).ravel())
    if shape == CYLINDER:
        return pv.Cylinder(direction=(0, 0, 1), radius=size[0], height=2 * size[1])
    if shape == CAPSULE:
        return pv.Capsule(direction=(0, 0, 1), radius=size[0], cylinder_length=2 * size[1])
    radii = size if shape == ELLIPSOID else np.full(3, size[0])
    return pv.Sphere(radius=1.0).scale(radii, inplace=False)


if __name__ == "__main__":
    main()
