"""A drawn world's document is, byte for byte, the one that MuJoCo's own writer gives."""

from functools import partial

import mujoco
import numpy as np
import pytest

from scenegen.base.limits import MAX_OTHERS
from scenegen.worlds.drawing import MAX_WRITTEN, Drawing
from tests.refusals import refuses

BOUNDS = np.array([[8.0, 8.0, 1.5], [32.0, 32.0, 4.25]])
SHAPES = [
    getattr(mujoco.mjtGeom, f"mjGEOM_{name}")
    for name in ("SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX")
]


def both(draw):
    """Whether this room writes a document itself, and that the document is MuJoCo's."""
    ours, theirs = Drawing(BOUNDS), Drawing(BOUNDS)
    draw(ours)
    assert theirs.geoms == []  # from here on, it is a MjSpec
    draw(theirs)
    assert ours.mjcf() == theirs.mjcf()
    return ours._spec is None


def awkward(rng):
    """A number that six digits may not hold."""
    digits = rng.integers(1, 9)
    return float(np.round(rng.uniform(-1.0, 1.0), digits) * 10.0 ** rng.integers(-9, 7))


@pytest.mark.parametrize("seed", range(30))
def test_any_solids_are_written_as_mujocos(seed):
    def draw(drawing):
        rng = np.random.default_rng(seed)
        for _ in range(40):
            options = {}
            if rng.random() < 0.7:
                upright = np.eye(4)[rng.integers(4)] * rng.choice([-1, 1])
                turn = rng.normal(size=4) if rng.random() < 0.8 else upright
                options["quat"] = turn / np.sqrt((turn**2).sum())
            if rng.random() < 0.5:
                options["rgba"] = [*rng.random(3).round(rng.integers(1, 9)), 1.0]
            size = [abs(awkward(rng)) + 1e-3 for _ in range(3)]
            place = [awkward(rng) * rng.integers(2) for _ in range(3)]
            drawing.add_geom(SHAPES[rng.integers(len(SHAPES))], size, place, **options)

    both(draw)


def test_what_is_not_written_here_is_left_to_mujoco():
    def draw(drawing, **options):
        drawing.add_geom(SHAPES[0], [0.5, 0, 0], [1, 2, 3])
        drawing.add_geom(mujoco.mjtGeom.mjGEOM_PLANE, [1, 1, 1], [0, 0, 0], **options)

    def draw_many(drawing):
        for n in range(MAX_WRITTEN + 1):
            drawing.add_geom(SHAPES[0], [0.1, 0, 0], [n, 0, 0])

    for draw_world in (draw, partial(draw, name="floor"), draw_many):
        assert not both(draw_world)


def test_a_kind_may_use_all_of_mujocos_spec():
    drawing = Drawing(BOUNDS)
    drawing.add_geom(SHAPES[0], [0.5, 0, 0], [1, 2, 3])
    drawing.worldbody.add_geom(type=SHAPES[4], size=[1, 1, 1], name="by name")
    drawing.add_geom(SHAPES[0], [0.25, 0, 0], [3, 2, 1])
    model = mujoco.MjModel.from_xml_string(drawing.mjcf().decode())
    assert model.ngeom == 3
    assert model.geom("by name").size.tolist() == [1, 1, 1]
    with pytest.raises(AttributeError):
        _ = drawing.no_such_attribute


def test_a_kind_draws_nothing_that_readers_refuse():
    drawing = Drawing(BOUNDS)
    for n in range(MAX_OTHERS + 1):
        drawing.worldbody.add_site(name=str(n))
    refuses(f"more than {MAX_OTHERS} elements", drawing.mjcf)
