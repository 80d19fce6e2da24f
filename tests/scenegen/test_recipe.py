"""Recipes of any values either end in one line, or make a manifest that every reader takes."""

import dataclasses
import itertools
import json
import random
import tomllib
from pathlib import Path

import pytest

from scenegen import SPLITS
from scenegen.base.errors import RecipeError
from scenegen.base.limits import MAX_DRAWN_SOLIDS, MAX_SAMPLES_IN_SHARD, MAX_SEED
from scenegen.dataset.build import plan_dataset
from scenegen.dataset.manifest import encode, parse
from scenegen.dataset.schema import NAME
from scenegen.draw.source import DrawnWorlds
from scenegen.verification.files import read_contract
from scenegen.verification.report import Ledger
from scenegen.worlds.kinds import kind_names
from scenegen.worlds.recipe import make_recipe, preset, read_recipe
from tests.command_line import beside
from tests.refusals import refuses

NASTY = [*tomllib.loads(beside(__file__, "nasty.toml"))["nasty"], None, 1 << 20_000, [1] * 999]
"""Values as TOML could give them, and worse."""


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Looking up versions takes longer than all the rest."""
    monkeypatch.setattr("scenegen.dataset.build.software", dict)


def manifest_of(recipe):
    """The bytes of a manifest without shards, with the greatest seed that there may be."""
    plan = plan_dataset(
        *(Path("d"), recipe, DrawnWorlds(recipe)),
        seed=MAX_SEED,
        counts=dict.fromkeys(SPLITS, 0),
        shard_samples=MAX_SAMPLES_IN_SHARD,
    )
    return encode(plan.manifest)


def random_tables(chance, recipe):
    """A few parameters, of random values: nasty ones, and those that are there, scaled or mixed
    up."""
    tables = {}
    for _ in range(chance.choice((1, 1, 1, 2, 4))):
        name = chance.choice(("world", "flight", "accept", "lidar", "grid"))
        part = getattr(recipe, name)
        parameter = chance.choice([item.name for item in dataclasses.fields(part)])
        scaled, scale = getattr(part, parameter), 10.0 ** chance.uniform(-6, 8)
        if isinstance(scaled, tuple):
            scaled = [type(one)(one * scale) for one in scaled]
        elif type(scaled) in (int, float):
            scaled = type(scaled)(scaled * scale)
        value = chance.choice((scaled, scaled, chance.choice(NASTY)))
        tables.setdefault(name, {})[parameter] = value
    if chance.random() < 0.05:
        tables[chance.choice(("wrld", "\x1b[2J", "world", ""))] = chance.choice(NASTY)
    return tables


def test_a_recipe_of_any_values_ends_in_one_line_or_makes_a_manifest_that_readers_take(tmp_path):
    chance = random.Random(0)
    presets = {kind: preset(kind) for kind in kind_names()}
    made, lines = 0, []
    for _ in range(1000):
        kind = chance.choice(list(presets))
        try:
            recipe = make_recipe(kind, random_tables(chance, presets[kind]), where="test")
        except RecipeError as error:
            lines.append(str(error))
            continue
        manifest = manifest_of(recipe)
        checked = parse(manifest)
        assert (checked.grid, checked.lidar) == (recipe.grid, recipe.lidar)
        assert recipe.world.max_solids() <= MAX_DRAWN_SOLIDS
        if made % 20 == 0:
            (tmp_path / NAME).write_bytes(manifest)
            assert read_contract(tmp_path, Ledger()).recipe == recipe
        made += 1
    assert len(lines) > 300
    assert made > 200
    assert [line for line in lines if not line.isprintable() or len(line) > 400] == []
    assert [line for line in lines if "Input should" in line or "required" in line] == []


@pytest.mark.parametrize("kind", [*kind_names(), "scene"])
def test_every_preset_keeps_its_own_rules_and_reads_back(kind):
    recipe = preset(kind)
    plain = {
        name: dataclasses.asdict(part)
        for name in ("flight", "accept", "lidar", "grid", "world")
        if (part := getattr(recipe, name))
    }
    again = make_recipe(kind, json.loads(json.dumps(plain)), where="test")
    assert again == recipe == preset(kind, lidar="raster")


def test_whole_numbers_and_floats_make_the_same_dataset():
    """A recipe says 1 or 1.0; the manifest, and so the dataset's fingerprint, says one of them."""

    def manifest(whole, exact):
        grid = {"voxel_m": exact(1), "shape": [whole(8)] * 3}
        world, flight = {"density": [exact(0), exact(1)]}, {"viewpoints": whole(2)}
        tables = {"grid": grid, "world": world, "flight": flight}
        return manifest_of(make_recipe("pillar", tables, where="test"))

    assert manifest(int, float) == manifest(float, int)


def test_all_sorts_of_solids_are_counted_together():
    """Each alone would do."""
    alone = {"density": [0.001, 9.0]}, {"wall_density": [0.0, 9.0]}, {"clutter_density": [0.0, 0.9]}
    for world in alone:
        make_recipe("geometric", {"world": world}, where="test")
    for one, other in itertools.combinations(alone, 2):
        tables = {"world": one | other | {"clutter_count": [0, 18]}}
        refuses([*one, *other], make_recipe, "geometric", tables, where="test")


def test_a_parameter_without_default_is_asked_for(monkeypatch):
    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Bare(type(preset("pillar").world)):  # type: ignore[misc]
        posts: int

    monkeypatch.setattr("scenegen.worlds.recipe.find_kind", lambda name: Bare)
    refuses("posts", make_recipe, "pillar", {}, where="test")
    assert make_recipe("pillar", {"world": {"posts": 3}}, where="test").world.posts == 3


def test_a_recipe_as_large_as_may_be_is_read_in_bounded_time(tmp_path):
    lines = f"[{'a.' * 200}a]\n" + "".join(f"k{n:05d}=1\n" for n in range(6_000))
    (tmp_path / "r.toml").write_text(f'kind = "pillar"\n{lines}')
    refuses("deep", read_recipe, tmp_path / "r.toml")


def test_a_difficulty_is_the_kinds_own_or_refused(tmp_path):
    hard = preset("pillar", difficulty="hard")
    named = dataclasses.replace(hard, difficulty="very-hard")  # as a user's own kind may have it
    assert parse(manifest_of(named)).graded == "pillar-very-hard"
    path = tmp_path / "r.toml"
    path.write_text('kind = "pillar"\ndifficulty = "hard"\n[world]\nround_share = 0.5\n')
    assert read_recipe(path).world == dataclasses.replace(hard.world, round_share=0.5)
    for kind, level in (("pillar", "harder"), ("scene", "hard")):
        refuses(kind, make_recipe, kind, {"difficulty": level}, where="test")
    refuses("twice", read_recipe, path, difficulty="easy")


def test_a_difficulty_whose_values_are_anothers_is_refused():
    def make(level, density):
        tables = {"difficulty": level, "world": {"density": density}}
        return make_recipe("clutter", tables, where="test")

    refuses("medium", make, "hard", [0.02, 0.08])
    refuses("hard", make, "easy", [0.05, 0.5])
    assert make("hard", [0.02, 0.081]).difficulty == "hard"
