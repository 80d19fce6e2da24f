"""The doctor says that a machine is fit where it is, and that it is not where a law is broken."""

import dataclasses
import itertools
import json
from types import SimpleNamespace

import numpy as np
import pytest

from scenegen.cli import doctor
from scenegen.draw.draw import draw_unit
from tests.command_line import run


@pytest.fixture(autouse=True)
def short(monkeypatch):
    """The self-test has time for two units, however slow the machine."""
    clock = itertools.count(0.0, 0.4 * doctor.SELF_TEST_S)
    monkeypatch.setattr(doctor, "time", SimpleNamespace(perf_counter=clock.__next__))


def spoil(monkeypatch, change):
    """Have the doctor draw units of whose last sample fields are changed by `change`, which is told
    the number of the draw; the numbers of the units are noted."""
    asked = []

    def spoilt(*arguments, **named):
        unit = draw_unit(*arguments, **named)
        *others, last = unit.samples
        last = dataclasses.replace(last, **change(len(asked), last))
        asked.append(named["unit"])
        return dataclasses.replace(unit, samples=(*others, last))

    monkeypatch.setattr("scenegen.draw.draw.draw_unit", spoilt)
    return asked


def without_one_solid_voxel(number, sample):
    """As if the truth missed a voxel in which something returned."""
    occupancy = sample.occupancy.copy()
    occupancy[tuple(np.argwhere(sample.observed)[-1])] = False
    return {"occupancy": occupancy}


def with_a_range_that_changes(number, sample):
    """As if rays depended on what was cast before."""
    return {"ranges": sample.ranges + np.float32(1e-3 * number)}


BROKEN = {"returns_occupied": without_one_solid_voxel, "repeatable": with_a_range_that_changes}


def test_a_fit_machine_is_found_fit(monkeypatch):
    units = spoil(monkeypatch, lambda number, sample: {})
    report = doctor.examine()
    test = report["self_test"]
    assert report["ok"] is test["repeatable"] is test["returns_occupied"] is True
    assert units == [0, 0, 0, 1]  # the same unit twice, then one after the other
    assert test["samples"] == 10
    assert test["samples_per_second_per_core"] > 0
    json.dumps(report, allow_nan=False)


@pytest.mark.parametrize("law", BROKEN)
def test_the_command_fails_where_a_law_is_broken(law, monkeypatch, capsys):
    spoil(monkeypatch, BROKEN[law])
    code, said, error = run(capsys, "doctor --json")
    assert code == 1
    assert "self-test failed" in error.splitlines()[-1]
    found = json.loads(said)["self_test"]
    assert {name: found[name] for name in BROKEN} == {name: name != law for name in BROKEN}


def test_a_module_that_does_not_load_is_named(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "COMPILED", ("mujoco", "libwhatever.so"))
    code, said, error = run(capsys, "doctor --json")
    assert code == 1
    assert error.count("\n") == 1
    assert json.loads(said)["libwhatever"] == "No module named 'libwhatever'"
