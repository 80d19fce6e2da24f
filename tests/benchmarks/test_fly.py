"""What benchmarks/fly.py says of flights."""

import importlib

import numpy as np
import pytest

from tests.command_line import ROOT


@pytest.fixture
def fly(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    return importlib.import_module("fly")


def row(robot, kind="maze", seed=1, mission=0, outcome="success", blocked=1, score=0.5):
    numbers = blocked, score, 1.0, 8.0, 4.0, 1.0, 0.9, 0.3
    return ["drawn", robot, kind, "hard", str(seed), str(mission), outcome, *map(str, numbers), ""]


@pytest.mark.parametrize(
    ("sign", "mean", "spread", "p", "said"),
    [
        (1, 0.04, 0.01, 0.01, "shown"),
        (1, -0.04, 0.01, 0.01, "contradicted"),
        (-1, -0.04, 0.01, 0.01, "shown"),
        (1, 0.0, 0.001, 0.9, "ruled out"),
        (-1, 0.0, 0.001, 0.9, "ruled out"),
        (1, 0.0, 0.1, 0.9, "open"),
    ],
)
def test_a_verdict_follows_from_p_sign_and_interval(fly, sign, mean, spread, p, said):
    values = mean + spread * np.tile([-1.0, 1.0], 20)
    claim = fly.Claim("drawn", "anywhere", "optimistic", "score", sign)
    assert fly.verdict(claim, values, p) == said


def test_worlds_count_alike_however_many_of_their_lines_are_blocked(fly, tmp_path):
    file = tmp_path / "flights.csv.gz"
    scores = {("anywhere, brakes", 1): 0.4, ("anywhere, brakes", 2): 0.1}
    for robot in fly.PAIR:
        rows = []
        for seed, lines in ((1, (1, 1, 1)), (2, (1, 0, 0))):
            score = scores.get((robot, seed), 0.2)
            # where the line is free, the score is another one, which does not count
            rows += [
                row(robot, seed=seed, mission=n, blocked=line, score=score if line else 3 * score)
                for n, line in enumerate(lines)
            ]
        fly.keep(rows, file)
    flights = fly.by_run(file)["drawn"]
    gains = fly.gain(*(flights[name] for name in reversed(fly.PAIR)), fly.BLOCKED)
    assert gains == pytest.approx([0.2, -0.1])


def test_flights_flown_again_take_the_place_of_the_old_ones(fly, tmp_path):
    file, (first, second) = tmp_path / "flights.csv.gz", fly.PAIR
    for robot, outcome in ((first, "timeout"), (second, "success"), (first, "left")):
        fly.keep([row(robot, outcome=outcome)], file)
    assert [(one[1], one[6]) for one in fly.read(file)] == [(first, "left"), (second, "success")]


def test_some_are_the_first_worlds_of_each_kind_and_level(fly):
    kinds = ("maze", "rooms")
    rows = [row("truth", kind=kind, seed=seed) for kind in kinds for seed in (7, 9, 12)]
    chosen = fly.some(fly.measured(rows))
    assert [*zip(chosen["world"], chosen["seed"], strict=True)] == [
        (kind, seed) for kind in kinds for seed in ("7", "9")
    ]
