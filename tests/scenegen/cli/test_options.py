"""Options are the fields of a configuration: name, type, choices, bounds and default stand there
alone."""

from dataclasses import dataclass
from typing import Literal

import pytest
import rich_click as click
from click.testing import CliRunner

from lidarsim.parameters import check, number
from scenegen.cli.options import fields_in, options_of


@dataclass(frozen=True, kw_only=True)
class Config:
    width: int = number(8, minimum=1, maximum=64)
    reach_m: float = number(1.5, above=0)
    stride: Literal[1, 2] = 2
    mode: Literal["plain", "rich"] = "rich"
    turned: bool = False
    other: int = 3

    def __post_init__(self):
        check(self)


@click.command()
@options_of(
    Config, width="Channels.", reach_m="How far.", stride="Step.", mode="Which.", turned="Whether."
)
def command(**options):
    config = Config(**fields_in(Config, {**options, "nothing": 1}))
    click.echo(repr(config))


def run(*words):
    ended = CliRunner().invoke(command, words)
    return ended.exit_code, ended.output


def test_what_is_given_has_the_fields_type_and_what_is_not_is_as_it_comes():
    assert run() == (0, f"{Config()!r}\n")
    found = run("--width=4", "--reach=2", "--stride=1", "--mode=plain", "--turned")
    expected = Config(width=4, reach_m=2.0, stride=1, mode="plain", turned=True)
    assert found == (0, f"{expected!r}\n")


BEYOND = "--width=65 --width=0 --width=1.5 --reach=0 --reach=many --reach=nan --reach=inf"


@pytest.mark.parametrize("word", [*BEYOND.split(), "--stride=3", "--mode=odd"])
def test_bounds_and_choices_are_the_fields(word):
    code, said = run(word)
    assert code == 2
    assert word.partition("=")[0] in said
