"""The doctor says that a machine is fit where it is, and that it is not where a law is broken."""

import dataclasses
import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scenegen.cli import doctor
from scenegen.draw import Unit, draw_unit
from scenegen.run.software import installed
from scenegen.sample import Sample
from tests.command_line import run


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "SELF_TEST_S", 0.1)


def spoil(monkeypatch: pytest.MonkeyPatch, change: Callable[[int, Sample], Sample]) -> None:
    """Have the doctor draw units whose last sample is changed by `change`, which is told the number
    of the draw."""
    draws = itertools.count()

    def spoilt(*arguments: Any, **named: Any) -> Unit:
        unit = draw_unit(*arguments, **named)
        samples = (*unit.samples[:-1], change(next(draws), unit.samples[-1]))
        return dataclasses.replace(unit, samples=samples)

    monkeypatch.setattr("scenegen.draw.draw_unit", spoilt)


def without_one_solid_voxel(number: int, sample: Sample) -> Sample:
    """As if the truth missed a voxel in which something returned."""
    occupancy = sample.occupancy.copy()
    occupancy[tuple(np.argwhere(sample.observed)[-1])] = False
    return dataclasses.replace(sample, occupancy=occupancy)


def with_a_range_that_changes(number: int, sample: Sample) -> Sample:
    """As if rays depended on what was cast before."""
    ranges = sample.ranges.copy()
    ranges[np.isfinite(ranges)] += np.float32(1e-3 * number)
    return dataclasses.replace(sample, ranges=ranges)


BROKEN = {"returns_occupied": without_one_solid_voxel, "repeatable": with_a_range_that_changes}


def test_a_fit_machine_is_found_fit(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = []

    def noted(*arguments: Any, **named: Any) -> Unit:
        asked.append(named["unit"])
        return draw_unit(*arguments, **named)

    monkeypatch.setattr("scenegen.draw.draw_unit", noted)
    found = doctor.self_test()
    assert found["ok"] is found["repeatable"] is found["returns_occupied"] is True
    assert asked == [0, 0, *range(len(asked) - 2)], "the same unit twice, then one after the other"
    assert found["samples"] == 5 * (len(asked) - 2) > 0
    assert found["samples_per_second_per_core"] > 0
    code, said, _ = run(capsys, "doctor", "--json")
    assert code == 0
    assert json.loads(said)["ok"] is True


@pytest.mark.parametrize("law", BROKEN)
def test_a_broken_law_is_found(law: str, monkeypatch: pytest.MonkeyPatch) -> None:
    spoil(monkeypatch, BROKEN[law])
    found = doctor.self_test()
    assert found["ok"] is False
    assert {name: found[name] for name in BROKEN} == {name: name != law for name in BROKEN}
    assert doctor.examine()["ok"] is False


def test_a_law_broken_once_is_not_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the first unit of many."""
    monkeypatch.setattr(doctor, "SELF_TEST_S", 0.3)
    spoil(
        monkeypatch,
        lambda number, sample: without_one_solid_voxel(number, sample) if number == 2 else sample,
    )
    found = doctor.self_test()
    assert found["samples"] > 5
    assert found["returns_occupied"] is found["ok"] is False


@pytest.mark.parametrize("law", BROKEN)
@pytest.mark.parametrize("words", [(), ("--json",)])
def test_the_command_fails_where_a_law_is_broken(
    law: str,
    words: tuple[str, ...],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    spoil(monkeypatch, BROKEN[law])
    code, said, error = run(capsys, "doctor", *words)
    assert code == 1
    assert "self-test failed" in error.splitlines()[-1]
    if words:
        assert json.loads(said)["self_test"][law] is False


def test_it_tells_of_the_machine(tmp_path: Path) -> None:
    found = doctor.examine(tmp_path)
    assert found["cores"] >= 1
    assert found["disk_free_gb"] >= 0
    assert found["software"]["numpy"] == np.__version__
    json.dumps(found, allow_nan=False)


def test_a_missing_package_is_absent_and_one_that_is_there_has_its_version() -> None:
    assert installed("no-such-package-as-this") == "absent"
    assert installed("numpy") == np.__version__
