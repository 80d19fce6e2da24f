"""What every kind of world keeps."""

import dataclasses
import hashlib
import json
import math
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import scenegen
from scenegen.dataset.generation import plan_generation
from scenegen.draw.mixture import read_components
from scenegen.draw.source import DrawnWorlds
from scenegen.worlds.classes import CLASSES
from scenegen.worlds.drawing import Drawing
from scenegen.worlds.kinds import find_kind, kind_names, training_kinds
from scenegen.worlds.kinds.geometric import Geometric
from scenegen.worlds.kinds.parts import Parts
from scenegen.worlds.kinds.pillar import Pillar
from scenegen.worlds.labels import class_names, classes_of, labels_by
from scenegen.worlds.recipe import make_recipe, preset
from scenegen.worlds.world import write_world
from tests.refusals import refuses
from tests.scenegen import cases, each_case
from tests.scenegen.conftest import drawn_unit
from tests.scenegen.kinds import BOUNDS, Geom, draw

KINDS = pytest.mark.parametrize("kind", [find_kind(name) for name in kind_names()])


@pytest.mark.parametrize("kind", [Pillar, Geometric, find_kind("clutter")])
def test_the_floor_is_a_slab_with_its_top_at_0(kind):
    size = {"size_m": (12.0, 30.0, 5.0)}
    floor, *others = draw(kind(**size, ground=True, ground_m=0.6))
    assert floor.shape == Geom.mjGEOM_BOX
    numbers = [*floor.size, *floor.position, *floor.quaternion]
    assert_allclose(numbers, [6, 15, 0.3, 6, 15, -0.3, 1, 0, 0, 0])
    assert len(draw(kind(**size, ground=False))) == len(others)


@pytest.mark.parametrize("name", kind_names())
def test_a_presets_world_is_as_its_version_promises(name):
    """And is flown through. The table holds the version of every kind, and the first digits of the
    SHA-256 of its preset's first world: who changes one raises the version of the kind."""
    recipe = preset(name)
    unit = drawn_unit(recipe)
    first = name, str(recipe.version), hashlib.sha256(unit.world.mjcf).hexdigest()[:12]
    assert first in cases("kinds/first_worlds"), "add a new kind; raise an old one's version"
    for sample in unit.samples:
        cell = recipe.grid.index(sample.points(), sample.origin)
        inside = ((cell >= 0) & (cell < recipe.grid.shape)).all(axis=1)
        assert sample.occupancy[tuple(cell[inside].T)].all()
        assert 0.005 < sample.occupancy.mean() < 0.6


@pytest.mark.parametrize("name", kind_names())
@pytest.mark.parametrize("count", [1, pytest.param(8, marks=pytest.mark.slow)])
def test_the_harder_a_world_the_less_is_seen(name, count):
    visible = []
    for level in ("easy", "medium", "hard"):
        recipe = preset(name, difficulty=level)
        assert (recipe.world == preset(name).world) == (level == "medium")
        units = [drawn_unit(recipe, unit, split="val") for unit in range(count)]
        ranges = [sample.ranges for unit in units for sample in unit.samples]
        visible.append(np.minimum(ranges, recipe.lidar.max_range_m).mean())
    assert visible[0] > visible[1] > visible[2]


@pytest.mark.parametrize("end", [(4, 3, 1), (-4, 2, 2.5), (1, -7, -3), (-1e-9, -2, 0)])
def test_a_slab_reaches_from_one_point_to_another(end):
    """Its width is level without a roll, and turned by it about its length."""
    spec, parts, start = Drawing(BOUNDS), Parts(), (1, 2, 3)
    for roll in (0.0, 0.5):
        parts.slab("wall", start, end, 2.0, 0.2, roll)
    parts.add_to(spec)
    level, rolled = (
        Rotation.from_quat(it.quat, scalar_first=True).as_matrix() for it in spec.geoms
    )
    for geom, turn in zip(spec.geoms, (level, rolled), strict=True):
        assert_allclose(geom.pos, np.add(end, start) / 2)
        assert_allclose(2 * geom.size[0] * turn[:, 0], np.subtract(end, start), atol=1e-12)
        assert_allclose(geom.size[1:], [1.0, 0.1])
    assert abs(level[2, 1]) < 1e-12
    assert level[2, 2] > 0
    assert_allclose(level[:, 1] @ rolled[:, 1], np.cos(2 * np.arctan(0.5)))


@KINDS
def test_solids_are_within_what_the_kind_says(kind):
    for seed in range(3):
        solids = draw(kind(), seed)
        assert len(solids) <= kind().max_solids() + 1
        place = np.array([solid.position for solid in solids])
        assert (place >= [-3.0, -3.0, -1.0]).all()
        assert (place <= np.add(kind().size_m, (3.0, 3.0, 8.0))).all()


def test_kinds_for_testing_alone_have_a_test_split_only(tmp_path):
    alone = sorted(set(kind_names()) - set(training_kinds()))
    assert alone == ["orchard", "parking", "rubble", "scaffold"]
    assert {recipe.kind for recipe, _ in read_components()} == set(training_kinds())
    for split in ("train", "val"):
        refuses(split, scenegen.stream, "parking", split=split)
    refuses("generate", plan_generation, "parking", 10, out=tmp_path)
    for kind in alone:
        [plan] = plan_generation(kind, out=tmp_path).datasets
        assert plan.manifest.counts == {"train": 0, "val": 0, "test": 500}


def kind_of(name, parameters):
    """A kind of world with parameters as JSON."""
    values = json.loads(parameters).items()
    return find_kind(name)(**{k: tuple(v) if isinstance(v, list) else v for k, v in values})


@each_case("kinds/refused", "name parameters")
def test_what_takes_too_much_or_leaves_its_bounds_is_refused(name, parameters):
    refuses(f"{name} {parameters}", lambda: draw(kind_of(name, parameters)))


@each_case("kinds/drawn", "name values")
def test_what_does_not_go_together_is_refused(name, values, rng):
    tables = {"world": json.loads(values), "flight": {"margin_m": 0}}
    refuses(name, DrawnWorlds(make_recipe(name, tables)).world, "train", 0, rng=rng)


@pytest.mark.parametrize("name", sorted(set(kind_names()) - {"pillar", "geometric"}))
def test_every_solid_is_of_a_class(name, rng):
    add = partial(find_kind(name)().add_to, rng=rng)
    world = write_world(add, flight_bounds=BOUNDS)
    names, labels = class_names(world.model, "class"), labels_by("class", ())
    # what has no material would be of the class of its shape
    assert names == class_names(world.model, "material") or name == "clutter"
    assert labels.classes == ("nothing", *CLASSES)
    assert [labels.classes[number] for number in classes_of(world, labels)] == names


@KINDS
def test_bad_values_are_named(kind):
    """Values that no parameter like this one can have."""
    for field in dataclasses.fields(kind):
        values = [math.nan, -0.1] if field.name != "ground" else ["yes"]
        if isinstance(field.default, tuple):
            low, *others = field.default
            values = [(math.nan, *others), (-1, *others)]
            values += [(others[0] + 1, low)] if len(others) == 1 else []
        for value in values:
            with pytest.raises(ValueError, match=field.name):
                kind(**{field.name: value})
