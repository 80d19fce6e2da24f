"""What makes a dataset again: the command, and the kind, whose module only the user can have
imported."""

import shlex
from importlib.metadata import version

import pytest
from scenegen.dataset.trust import parse
from scenegen.share.regenerate import check_kind, closure, command, environment_lock

from scenegen.cli.generate import generate
from scenegen.dataset import manifest
from scenegen.errors import PublishError
from tests.conftest import plan_of


def test_a_kind_of_somebody_elses_has_to_be_named():
    for there, named in (("pillar", None), ("a:B", "a:B")):
        check_kind(there, named)
    for there, named in (("a:B", None), ("a:B", "a:C"), ("nobodys", None), ("a:B", "pillar")):
        with pytest.raises(PublishError, match="--kind"):
            check_kind(there, named)


@pytest.mark.parametrize("engine", ["my_engine:Slow", None])
def test_the_command_that_makes_a_dataset_again_is_one_that_generate_takes(engine, tmp_path):
    plan = plan_of(tmp_path, seed=3, counts={"train": 5, "val": 1, "test": 0})
    unsigned = manifest.assemble(plan.parameters, [], complete=False) | {"engine": engine}
    if engine is None:  # as of datasets from before there was another engine
        del unsigned["engine"]
    name, verb, *words = shlex.split(command(parse(unsigned, tmp_path), "again"))
    asked = generate.make_context("generate", words).params
    assert (name, verb) == ("scenegen", "generate")
    assert (asked["engine"], asked["seed"], asked["n"]) == (engine or "mujoco", 3, 5)


def test_the_lock_pins_what_is_needed_as_the_dataset_s_makers_had_it():
    needed = closure("scenegen-lidar")
    for name in ("numpy", "mujoco", "llvmlite"):
        assert needed[name] == version(name)
    assert not {"pytest", "pyvista", "scenegen", "huggingface-hub"} & set(needed)
    made_with = {"numpy": "2.0.1", "scenegen": "0.0.9", "machine": "x86_64"}
    head, _, *lines = environment_lock(made_with).splitlines()
    assert head.startswith("# scenegen 0.0.9, published with ")
    assert "numpy==2.0.1" in lines
    assert [line.partition("==")[0] for line in lines] == sorted(needed)
