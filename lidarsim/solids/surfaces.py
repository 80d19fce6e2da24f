"""Triangles of MuJoCo's meshes and height fields."""

import mujoco
import numpy as np

from lidarsim.grid import Floats, Ints


def mesh_surface(model: mujoco.MjModel, mesh: int) -> tuple[Floats, Ints, bool]:
    """Vertices, faces (outward where closed) and whether the mesh is closed."""
    import trimesh  # takes a second to load, and few worlds hold a mesh

    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    face, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    soup = trimesh.Trimesh(
        model.mesh_vert[first : first + count].astype(np.float64),
        model.mesh_face[face : face + faces],
    )
    if not _is_closed(soup.faces) and soup.is_watertight:
        trimesh.repair.fix_winding(soup)
    return np.asarray(soup.vertices), np.asarray(soup.faces, dtype=np.int64), _is_closed(soup.faces)


def _is_closed(faces: Ints) -> bool:
    """Whether every edge is walked as often one way as the other by the triangles (T, 3) around it.

    Then each point off the surface has a winding number, also where more than two triangles share
    an edge, as between two boxes that touch along it.
    """
    tail, head = (
        faces.reshape(-1).astype(np.int64),
        np.roll(faces, -1, axis=1).reshape(-1).astype(np.int64),
    )
    count = int(faces.max(initial=0)) + 1
    return bool(np.array_equal(np.sort(tail * count + head), np.sort(head * count + tail)))


def height_field(model: mujoco.MjModel, field: int) -> tuple[Floats, Ints, bool]:
    """MuJoCo's surface (each cell cut along the diagonal from its least x and y to its greatest),
    walls, and base."""
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    first = int(model.hfield_adr[field])
    half_x, half_y, top, base = model.hfield_size[field]
    height = (
        model.hfield_data[first : first + rows * columns].reshape(rows, columns).astype(np.float64)
        * top
    )
    y, x = np.meshgrid(
        np.linspace(-half_y, half_y, rows), np.linspace(-half_x, half_x, columns), indexing="ij"
    )
    above = np.stack([x, y, height], axis=-1).reshape(-1, 3)
    below = np.stack([x, y, np.full_like(height, -base)], axis=-1).reshape(-1, 3)
    number = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (
        part.ravel()
        for part in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1])
    )
    surface = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    rim = np.concatenate([number[0, :-1], number[:-1, -1], number[-1, :0:-1], number[:0:-1, 0]])
    ahead, under = np.roll(rim, -1), rows * columns
    walls = np.concatenate(
        [np.stack([rim, rim + under, ahead], 1), np.stack([ahead, rim + under, ahead + under], 1)]
    )
    return (
        np.concatenate([above, below]),
        np.concatenate([surface, surface[:, ::-1] + under, walls]),
        True,
    )
