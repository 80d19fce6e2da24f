"""A user's own kind, method and command, as the docs show them, by the installed script in a folder
of the user's."""

import json

import pytest

from tests.command_line import SMALL, done, example, page, rows
from tests.refusals import refuses_command
from tests.scenegen import each_case

EXAMPLES = """
my_methods.py  → bench.md    → class Grown
my_commands.py → commands.md → def fill
"""
OTHERS = ("model.py", "cli.py", "data.py", "tests/__init__.py", "tests/helpers.py")
"""Modules of the user's that have nothing to do with it, under names that are common in the
field."""


@pytest.fixture
def here(tmp_path):
    """A user's folder, with the examples of the docs."""
    for name in OTHERS:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("raise AssertionError('imported, and nobody asked for it')")
    for name, shown, words in rows(EXAMPLES):
        (tmp_path / name).write_text(example(shown, words))
    (tmp_path / "my_worlds.py").write_text(page("examples/my_worlds.py"))
    own = SMALL.replace('"pillar"', '"my_worlds:Vineyard"\ndifficulty = "hard"')
    (tmp_path / "vineyard.toml").write_text(own)
    return tmp_path


def test_a_kind_a_method_and_a_command_of_ones_own(here, shell):
    def done(words):
        return shell.done(*words.split(), here=here)

    folder = "data/Vineyard"
    done("generate --recipe vineyard.toml -n 6 --workers 2 --labels class")
    assert '"kind": "my_worlds:Vineyard"' in (here / folder / "dataset.json").read_text()
    assert "ok" in regenerated(done(f"verify {folder} --workers 2 --kind my_worlds:Vineyard"))
    done(f"generate --like {folder}/dataset.json --kind my_worlds:Vineyard -o again --workers 2")
    one, other = (here / name / "dataset.json" for name in (folder, "again"))
    assert one.read_bytes() == other.read_bytes()
    publish = f"publish {folder} --repo ada/vineyard --dry-run"
    done(f"{publish} --quick --kind my_worlds:Vineyard --out out")
    assert "world 0, viewpoint" in done(f"my_commands:fill {folder}")
    (here / "my_worlds.py").write_text(
        "raise AssertionError('imported because a manifest names it')"
    )
    methods = "--method my_methods:Grown --method returns"
    assert "grown" in done(f"bench {folder} {methods} --quick --workers 2")
    said = done(f"verify {folder} --workers 2")
    assert "cannot be drawn again" in regenerated(said)
    assert "21 passed, 1 skipped" in said
    done(f"world {folder} 0")
    ended = shell.scenegen(*publish.split(), here=here)
    assert ended.code == 1
    assert "give --kind" in ended.err
    assert ended.err.count("\n") == 1


def regenerated(table):
    """The line of what was drawn again."""
    (line,) = (line for line in table.splitlines() if line.startswith("regenerated"))
    return line


@pytest.fixture
def mixture(standing, capsys):
    """A collection of hard worlds of pillars and of a kind of the user's."""
    (standing / "my_worlds.py").write_text(page("examples/my_worlds.py"))
    kinds = "pillar", "my_worlds:Vineyard"
    components = (f'[[component]]\nkind = "{kind}"\ndifficulty = "hard"\n' for kind in kinds)
    text = SMALL.replace('"pillar"', '"mixed"') + "".join(components)
    (standing / "mix.toml").write_text(text)
    done(capsys, "generate --recipe mix.toml -n 6 --val 0 --test 0 --out mix --workers 1 --quiet")
    return standing / "mix"


@pytest.mark.parametrize(
    ("folder", "names"),
    [
        ("pillar", "pillar pillar-hard"),
        ("Vineyard", "Vineyard Vineyard-hard my_worlds:Vineyard my_worlds:Vineyard-hard"),
    ],
)
def test_a_plain_kind_takes_every_difficulty(folder, names, mixture, capsys):
    for name in names.split():
        done(capsys, f"take mix --kind {name} -o taken.json --quiet --workers 1")
        (taken,) = json.loads((mixture.parent / "taken.json").read_text())["datasets"]
        assert taken["path"] == f"mix/{folder}-hard"
        assert taken["samples"] == {"train": [0, 1, 2]}


@pytest.mark.parametrize("kind", ["pillar-medium", "Vineyard-easy", "cave"])
def test_kinds_are_named_where_none_is_taken(kind, mixture, capsys):
    refuses_command(capsys, f"take mix --kind {kind} -o none.json")


def test_a_collections_worlds_of_the_kind_are_drawn_again(mixture, capsys):
    def skipped(options):
        report = json.loads(done(capsys, f"verify mix --workers 1 --json {options}"))
        return {
            check["name"]: check["skipped"]
            for check in report["checks"]
            if check["name"].endswith("regenerated")
        }

    pillar, vineyard = "pillar-hard: regenerated", "Vineyard-hard: regenerated"
    assert skipped("") == {pillar: False, vineyard: True}
    assert skipped("--kind my_worlds:Vineyard") == {pillar: False, vineyard: False}
    refuses_command(capsys, "verify mix --kind my_worlds:Orchard")


WRONG = f"""
def gone():
    raise KeyError("gone")
import click
from dataclasses import dataclass
from scenegen.worlds.kinds.kind import WorldKind
class Other: pass
@dataclass(frozen=True, kw_only=True)
class Empty(WorldKind):
    version, crowded_by = 1, ()
class Bare(Empty):
    def add_to(self, spec, *, rng): pass
@dataclass(frozen=True, kw_only=True)
class Odd(Bare):
    label: object = 1j
@dataclass(frozen=True, kw_only=True)
class Sparse(Bare):
    crowded_by = "ground_m", "-size_m"
    def add_to(self, spec, *, rng): spec.add_geom(2, (1, 0, 0), (200, 0, 1))
@dataclass(frozen=True, kw_only=True)
class Crowded(Bare):
    crowded_by = ("-row",)
@dataclass(frozen=True, kw_only=True)
class Graded(Bare):
    graded = {{"hard": {{"size": (1, 1, 1)}}}}
@dataclass(frozen=True, kw_only=True)
class Leafy(Bare):
    def add_to(self, spec, *, rng):
        spec.add_geoms([2], [[1, 0, 0]], [[0, 0, 1]], classes=["vegetaton"])
class Short:
    name = "short"
    def complete(self, observed): pass
def plain(): pass
@click.command()
def failing(): gone()
class Failed(Exception):
    def __init__(self, one, two): super().__init__(one)
class Broken(Short):
    def complete(self, observed, free, *, grid): gone()
class Worse(Short):
    def complete(self, observed, free, *, grid): raise Failed("two", 2)
class Still:
    of = classmethod(lambda cls, model, data=None: gone())
    cast = None
@dataclass(frozen=True, kw_only=True)
class Ray:
    shape, times_s, directions_body, max_range_m = (1,), [0.0], [[1.0, 0.0, 0.0]], -3
@dataclass(frozen=True, kw_only=True)
class Failing(Bare):
    def add_to(self, spec, *, rng): gone()
@dataclass(frozen=True, kw_only=True)
class {"K" * 95}(Bare): pass
@dataclass(frozen=True, kw_only=True)
class Heavy(Bare):
    def max_solids(self): return 3
    def add_to(self, spec, *, rng): spec.add_geoms([2] * 25_000, [1, 0, 0], [0, 0, 1])
@dataclass(frozen=True, kw_only=True)
class Heavier(Heavy):
    def add_to(self, spec, *, rng):
        spec.worldbody.add_geom(size=[1, 0, 0])
        super().add_to(spec, rng=rng)
"""


@each_case("../own", "words")
def test_one_that_lacks_something_is_told_in_one_line(words, standing, made, capsys):
    (standing / "wrong.py").write_text(WRONG)
    (standing / "ends.py").write_text("import sys\nsys.exit(3)\n")
    (standing / "fails.toml").write_text('kind = "wrong:Failing"')
    (standing / "made").symlink_to(made)
    refuses_command(capsys, words)
    assert not (standing / "data").exists()
