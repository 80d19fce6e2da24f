"""A user's own kind, method and command, as the docs show them, by the installed script in a folder
of the user's."""

import pytest

from tests.command_line import ROOT, SMALL, refused, rows

EXAMPLES = {
    "my_worlds.py": "recipes.md",
    "my_methods.py": "bench.md",
    "my_commands.py": "commands.md",
}
OTHERS = ("model.py", "cli.py", "data.py", "tests/__init__.py", "tests/helpers.py")
"""Modules of the user's that have nothing to do with it, under names that are common in the
field."""


def example(page):
    """The last Python file that a page of the docs shows: a block that begins with a docstring."""
    blocks = (ROOT / "docs" / page).read_text().split("```python\n")
    return [block for block in blocks if block.startswith('"""')][-1].split("```")[0]


@pytest.fixture
def here(tmp_path):
    """A user's folder, with the examples of the docs."""
    for name in OTHERS:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("raise AssertionError('imported, and nobody asked for it')")
    for name, page in EXAMPLES.items():
        (tmp_path / name).write_text(example(page))
    own = SMALL.replace('"pillar"', '"my_worlds:Fence"').replace("min_solids = 1", "min_solids = 0")
    (tmp_path / "fence.toml").write_text(
        own.replace("[accept]", "[accept]\nmin_occupied_share = 0")
    )
    return tmp_path


def test_a_kind_a_method_and_a_command_of_ones_own(here, shell):
    def done(*words):
        return shell.done(*words, here=here)

    done("generate", "--recipe", "fence.toml", "-n", "6", "--workers", "2")
    assert '"kind": "my_worlds:Fence"' in (here / "data" / "Fence" / "dataset.json").read_text()
    assert "ok" in regenerated(
        done("verify", "data/Fence", "--workers", "2", "--kind", "my_worlds:Fence")
    )
    assert "world 0, viewpoint" in done("my_commands:fill", "data/Fence")
    (here / "my_worlds.py").write_text(
        "raise AssertionError('imported because a manifest names it')"
    )
    words = ("--method", "my_methods:Grown", "--method", "returns", "--quick", "--workers", "2")
    assert "grown" in done("bench", "data/Fence", *words)
    assert "cannot be drawn again" in regenerated(done("verify", "data/Fence", "--workers", "2"))
    done("world", "data/Fence", "0")
    ended = shell.scenegen("publish", "data/Fence", "--repo", "ada/fence", "--dry-run", here=here)
    assert (ended.code, "give --kind" in ended.err, ended.err.count("\n")) == (1, True, 1)


def regenerated(table):
    """The line of what was drawn again."""
    (line,) = (line for line in table.splitlines() if line.startswith("regenerated"))
    return line


LACKING = f"""
generate --quiet --kind absent:Fence   → there is no module absent
generate --quiet --kind wrong:Other    → lacks `version`, a whole number
generate --quiet --kind wrong:Bare     → class Mine(scenegen.WorldKind)
generate --quiet --kind wrong:Odd      → cannot stand in a manifest
generate --quiet --kind wrong:{"K" * 95} → at most 100 characters
bench DATASET --quiet --method wrong:Nameless → lacks a `name`, a string
bench DATASET --quiet --method wrong:Short    → `complete` that takes (observed, free, *, grid)
bench DATASET --quiet --method wrong:Needy    → without arguments
wrong:plain                            → lacks `make_context`
trian                                  → did you mean 'train'?
generate --quiet --kind wrong:Failing --workers 1    → line 3 of wrong.py: KeyError: 'gone'
generate --quiet --recipe fails.toml --n 99 --shard-samples 3 --workers 2 → line 3 of wrong.py: Key
bench DATASET --quiet --method wrong:Broken   → line 3 of wrong.py: KeyError: 'gone'
bench DATASET --quiet --method wrong:Worse --workers 2 → of wrong.py: Failed: two
wrong:failing                          → line 3 of wrong.py: KeyError: 'gone'
ends:all                               → importing it fails (line 2 of ends.py): SystemExit
generate --quiet --kind pillar --workers 1 --engine wrong:Still → line 3 of wrong.py: KeyError
generate --quiet --kind pillar --workers 1 --engine wrong:Short → `of`
"""
WRONG = f"""
def gone():
    raise KeyError("gone")
import click
from dataclasses import dataclass
from scenegen.recipes.kind import WorldKind
class Other: pass
@dataclass(frozen=True, kw_only=True)
class Empty(WorldKind):
    version, crowded_by = 1, ()
class Bare(Empty):
    def add_to(self, spec, *, rng): pass
@dataclass(frozen=True, kw_only=True)
class Odd(Bare):
    label: object = 1j
class Nameless:
    def complete(self, observed, free, *, grid): pass
class Short:
    name = "short"
    def complete(self, observed): pass
class Needy(Short):
    def __init__(self, size): pass
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
class Failing(Bare):
    def add_to(self, spec, *, rng): gone()
@dataclass(frozen=True, kw_only=True)
class {"K" * 95}(Bare): pass
"""


@pytest.mark.parametrize(("words", "told"), rows(LACKING))
def test_one_that_lacks_something_is_told_in_one_line(words, told, standing, made, capsys):
    (standing / "wrong.py").write_text(WRONG)
    (standing / "ends.py").write_text("import sys\nsys.exit(3)\n")
    (standing / "fails.toml").write_text('kind = "wrong:Failing"')
    assert told in refused(capsys, words.replace("DATASET", str(made)))
    assert not (standing / "data").exists()
