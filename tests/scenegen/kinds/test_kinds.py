"""What every kind of world keeps."""

import dataclasses
import hashlib
import json
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose

from lidarsim import GridSpec
from scenegen.draw.source import DrawnWorlds
from scenegen.worlds.classes import CLASSES
from scenegen.worlds.kinds import find_kind, kind_names
from scenegen.worlds.kinds.geometric import Geometric
from scenegen.worlds.kinds.pillar import Pillar
from scenegen.worlds.labels import class_names, classes_of, labels_by
from scenegen.worlds.recipe import make_recipe, preset
from scenegen.worlds.world import compile_world, write_world
from tests.command_line import rows
from tests.scenegen import cases, refuses
from tests.scenegen.conftest import drawn_unit
from tests.scenegen.kinds import Geom, draw

KINDS = pytest.mark.parametrize("kind", [find_kind(name) for name in kind_names()])
SLABS = pytest.mark.parametrize("kind", [Pillar, Geometric, find_kind("clutter")])
FIRST = """
cave       → 1 → ad9fc0a1c523
clutter    → 1 → 4c7483af1d1f
forest     → 1 → 21481d986a00
geometric  → 2 → ad60acea7e21
industrial → 1 → bfdab9997ef6
maze       → 2 → 9dd10403b24c
pillar     → 2 → 5f2a09a7f6a7
rooms      → 2 → 8e9801a3a4eb
street     → 1 → c19322e14dc3
warehouse  → 1 → fb3a9857dd4b
"""
"""The version of every kind, and the first digits of the SHA-256 of its preset's first world. Who
changes one raises the version of the kind."""


@pytest.mark.parametrize("name", kind_names())
def test_a_world_of_a_preset_is_flown_through_and_is_the_one_that_its_version_promises(name):
    recipe = preset(name)
    unit = drawn_unit(recipe)
    first = name, str(recipe.version), hashlib.sha256(unit.world.mjcf).hexdigest()[:12]
    assert first in rows(FIRST), "a new kind adds this to FIRST; an old one raises its version"
    for sample in unit.samples:
        returns = sample.points()
        cell = np.floor((returns - sample.origin) / recipe.grid.voxel_m).astype(int)
        inside = ((cell >= 0) & (cell < recipe.grid.shape)).all(axis=1)
        assert sample.occupancy[tuple(cell[inside].T)].all()
        assert 0.005 < sample.occupancy.mean() < 0.6


@pytest.mark.parametrize("name", kind_names())
@pytest.mark.parametrize("count", [1, pytest.param(8, marks=pytest.mark.slow)])
def test_easy_medium_and_hard_are_so(name, count):
    """The harder a world is, the less far its scans see."""
    visible = []
    for level in ("easy", "medium", "hard"):
        recipe = preset(name, difficulty=level)
        assert (recipe.world == preset(name).world) == (level == "medium")
        found = [
            np.minimum(one.ranges, recipe.lidar.max_range_m)
            for unit in range(count)
            for one in drawn_unit(recipe, unit, split="val").samples
        ]
        visible.append(np.mean(found))
    assert visible[0] > visible[1] > visible[2]


@KINDS
def test_solids_are_within_what_the_kind_says(kind):
    for seed in range(3):
        solids = draw(kind(), seed)
        assert len(solids) <= kind().max_solids() + 1
        place = np.array([solid.position for solid in solids])
        assert (place >= [-3.0, -3.0, -1.0]).all()
        assert (place <= np.add(kind().size_m, (3.0, 3.0, 8.0))).all()


def kind_of(name, given):
    """A kind of world with what is given as JSON."""
    values = json.loads(given).items()
    return find_kind(name)(**{k: tuple(v) if isinstance(v, list) else v for k, v in values})


@pytest.mark.parametrize(("name", "given"), cases("kinds/kinds_too_much"))
def test_what_would_take_too_much_memory_is_refused(name, given):
    with pytest.raises(ValueError, match=r"expected [0-9]+ at most"):
        draw(kind_of(name, given))


@pytest.mark.parametrize(
    ("name", "given"), [("street", {"storeys": [0, 0]}), ("cave", {"size_m": [0.1, 0.1, 1]})]
)
def test_what_does_not_go_together_is_refused(name, given):
    drawn = DrawnWorlds(make_recipe(name, {"world": given, "flight": {"margin_m": 0}}))
    refuses(
        "take values nearer to the preset's",
        lambda: drawn.world("train", 0, rng=np.random.default_rng(0)),
    )


def world_of(kind, seed):
    bounds = np.array([[0.0, 0, 0], [1, 1, 1]])
    rng = np.random.default_rng(seed)
    return write_world(lambda spec: kind.add_to(spec, rng=rng), flight_bounds=bounds)


@pytest.mark.parametrize("name", sorted(set(kind_names()) - {"pillar", "geometric"}))
def test_every_solid_is_of_a_class(name):
    world = world_of(find_kind(name)(), 3)
    named = class_names(world.model, "class")
    # what has no material would be of the class of its shape
    assert named == class_names(world.model, "material") or name == "clutter"
    assert set(named) <= set(CLASSES)
    labels = labels_by("class", ())
    assert labels.classes == ("nothing", *CLASSES)
    assert [labels.classes[number] for number in classes_of(world, labels)] == named


@SLABS
def test_the_floor_is_a_slab_over_the_plan_with_its_top_at_0(kind):
    size = {"size_m": (12.0, 30.0, 5.0)}
    floor, *others = draw(kind(**size, ground=True, ground_m=0.6))
    assert floor.shape == Geom.mjGEOM_BOX
    assert_allclose(floor.size, [6.0, 15.0, 0.3])
    assert_allclose(floor.position, [6.0, 15.0, -0.3])
    assert floor.upright
    assert len(draw(kind(**size, ground=False))) == len(others)


def wrong(value):
    """Values that no parameter like this one can have."""
    if isinstance(value, tuple):
        pair = [(value[1] + 1, value[0])] if len(value) == 2 else []
        return [(float("nan"), *value[1:]), (-1, *value[1:]), *pair]
    return [float("nan"), -0.1]


@KINDS
def test_bad_values_are_named(kind):
    for field in dataclasses.fields(kind):
        for value in wrong(field.default) if field.name != "ground" else ["yes"]:
            with pytest.raises(ValueError, match=field.name):
                kind(**{field.name: value})


@pytest.mark.parametrize(("name", "given"), cases("kinds/kinds_bounds"))
def test_bounds_that_a_name_does_not_tell_are_kept(name, given):
    with pytest.raises(ValueError, match=re.findall(r"\w+", given)[0]):
        kind_of(name, given)


@KINDS
def test_the_truth_of_a_turned_world_is_the_turned_truth(kind):
    """Solids of whatever class, attitude and shape; flat ground and height fields among them."""
    world = world_of(kind(), 1)
    body = b'<body quat="0.7071067811865476 0 0 0.7071067811865476">'
    turned = world.mjcf.replace(b"<worldbody>", b"<worldbody>" + body, 1)
    turned = turned.replace(b"</worldbody>", b"</body></worldbody>", 1)
    x, y, z = kind().size_m[0] / 2, kind().size_m[1] / 2, 1.93
    grid = GridSpec(shape=(40, 40, 20))
    ours, theirs = (
        one.truth(grid, grid.origin_at(np.array(place)))["occupancy"]
        for one, place in ((world, (x, y, z)), (compile_world(turned), (-y, x, z)))
    )
    assert ours.any()
    # cubes that a solid touches within rounding may fall to either side
    assert (np.rot90(ours) != theirs).mean() < 1e-3
