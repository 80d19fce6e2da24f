"""What makes a dataset again: the command, and the kind, whose module only the user can have
imported."""

import dataclasses
import shlex
from pathlib import Path

import msgspec
import pytest

from scenegen.cli.generate import generate
from scenegen.dataset.read import Dataset
from scenegen.publish.card import command
from scenegen.publish.stage import examine
from tests.scenegen import refuses
from tests.scenegen.verification.forge import edit_at


@pytest.mark.parametrize("named", [None, "a:C", "pillar"])
def test_a_kind_of_somebody_elses_has_to_be_named(asked, dataset, named):
    edit_at(dataset, "recipe.kind", '"a:B"')
    refuses("--kind", lambda: examine(dataclasses.replace(asked, kind=named)))


@pytest.mark.parametrize(("engine", "named"), [("my:Slow", "my:Slow"), ("mujoco", None)])
def test_the_command_is_one_that_generate_takes(made, engine, named):
    manifest = msgspec.structs.replace(Dataset(made).manifest, engine=engine)
    program, verb, *words = shlex.split(command(manifest, "ada/again", "v1"))
    options = generate.make_context("generate", words).params
    assert (program, verb) == ("scenegen", "generate")
    assert (options["like"], options["engine"]) == (Path("dataset.json"), named)
