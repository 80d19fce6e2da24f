"""Chains: their text, their order, their streams of chance, and what bounds them."""

import dataclasses
import hashlib
import itertools
import math
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lidarsim import AnalyticEngine, Lidar, Pose, cast
from lidarsim.noise import STAGES, VERSION
from lidarsim.noise.chain import Noise
from lidarsim.sensors import CATALOGUE, SENSORS
from tests.command_line import example
from tests.lidarsim.engines.test_laws import model_of
from tests.refusals import refuses
from tests.scenegen import cases


@cache
def engine():
    return AnalyticEngine.of(model_of('type="plane" size="9 9 1"', 'size="1" pos="4 0 1"'))


@cache
def clean():
    return cast(engine(), Lidar(), Pose.level((0.0, 0.0, 2.0)))


def noisy(text, seed=0):
    """The scan as a chain of stages tells it."""
    return Noise.parse(text).observe(clean(), engine(), rng=np.random.default_rng(seed))


def test_no_noise_gives_the_clean_bits(rng):
    returns = Noise().observe(clean(), engine(), rng=rng)
    assert returns.ranges[0].astype(np.float32).tobytes() == clean().ranges.tobytes()
    assert_array_equal(returns.points(), clean().points())


@pytest.mark.parametrize("name", STAGES.builtin)
def test_every_stage_reads_back_from_its_text(name):
    stage = STAGES.find(name)()
    for item in dataclasses.fields(stage):
        value = getattr(stage, item.name)
        number = 7 if item.name in ("rays", "poses") else 0.25
        changed = {item.name: {bool: not value, str: "dual"}.get(type(value), number)}
        stages = (dataclasses.replace(stage, **changed),)
        assert Noise.parse(str(Noise(stages))).stages == stages
    assert str(Noise((stage,))) == name


def test_the_noise_of_a_data_sheet_is_a_chain():
    for sensor in map(SENSORS.find, CATALOGUE):
        chain = Noise.parse("datasheet", sensor)
        assert Noise.parse(sensor.noise) == chain
        assert 0 < chain.bound_m(10.0) < 10


def test_a_further_stage_changes_no_bits_before_it():
    shifted, other = (noisy("range", seed).ranges for seed in (0, 2))
    assert shifted.tobytes() != other.tobytes()
    both = noisy("range,dropout:0.2").ranges
    left = np.isfinite(both)
    assert 0 < left.sum() < np.isfinite(shifted).sum()
    assert_array_equal(both[left], shifted[left])


def test_bits_change_with_the_version_alone():
    returns = noisy(
        "motion,divergence,near,range:0.02:0.01,depth,quantise,dropout,far:0.5:1.7,grazing:30,"
        "faint,spurious,intensity:0.1"
    )
    digest = hashlib.sha256(returns.ranges.tobytes() + returns.intensity.tobytes()).hexdigest()
    assert VERSION == 2
    assert digest[:16] == "c8338a5de4b6fc28"


def test_no_return_moves_further_than_the_bound():
    text = "range:0.05:share=0.01,quantise:0.1,dropout,far,grazing,faint,near:3,depth"
    chain = Noise.parse(text)
    ranges = noisy(text).ranges[0]
    left = np.isfinite(ranges)
    assert left.sum() > 50
    assert np.abs(ranges[left] - clean().ranges[left]).max() <= chain.bound_m(Lidar().max_range_m)
    assert chain.bound_m(10.0) == sum(stage.bound_m(10.0) for stage in chain.stages)
    assert Noise.parse("range,spurious").bound_m(10.0) == math.inf


def test_stages_that_cast_come_first_and_once():
    ranks = {"motion": 0, "divergence": 1, "range": 2, "dropout": 2}
    for first, second in itertools.product(ranks, repeat=2):
        if ranks[first] < ranks[second] or ranks[first] == ranks[second] == 2:
            assert Noise.parse(f"{first},{second}")
        else:
            refuses((first, second), Noise.parse, f"{first},{second}")


OWN = f"""{example("noise.md", "# my_noise.py")}
from typing import ClassVar
@dataclass(frozen=True, kw_only=True)
class Shift:
    order: ClassVar[int] = 2
    by_m: float = 0.1
    def apply(self, returns, view, *, rng): return returns.but(ranges=returns.ranges + self.by_m)
    def bound_m(self, max_range_m): return abs(self.by_m)
class Signed(Shift):
    def apply(self, returns, rng): return returns
class Boundless(Shift):
    def bound_m(self): return 0.0
class Bare(Shift):
    def apply(self, returns, view, *, rng): return returns.ranges
class Empty(Shift):
    def apply(self, returns, view, *, rng): return returns.but(ranges=returns.ranges[:0])
class Single(Shift):
    def apply(self, returns, view, *, rng): return returns.but(ranges=returns.ranges[0])
class Without(Shift):
    def bound_m(self, max_range_m): return None
@dataclass(frozen=True, kw_only=True)
class Ranked(Shift):
    order: int = 2
"""


def test_a_stage_of_ones_own(standing):
    (standing / "my_noise.py").write_text(OWN)
    wrong = "Shift:9.5,range:0 Ranked:0:5 Signed Bare Single Empty Without Boundless"
    for text in wrong.split():
        refuses(text, noisy, f"my_noise:{text}")
    text = "my_noise:Shift:-0.5, range:0"
    assert str(Noise.parse(text)) == "my_noise:Shift:by_m=-0.5,range:sigma_m=0.0"
    ranges, met = noisy(text).ranges[0], np.isfinite(clean().ranges)
    left = np.isfinite(ranges)
    assert_allclose(ranges[left], clean().ranges[left] - 0.5, rtol=1e-6)
    left = np.isfinite(noisy("my_noise:Fog:10").ranges[0])
    expected = float(np.exp(-clean().ranges[met] / 5.0).sum())
    assert (met >= left).all()
    assert left.sum() == pytest.approx(expected, abs=4 * expected**0.5)


@pytest.mark.parametrize("text", ["", *sum(cases("../lidarsim/noise"), ())])
def test_a_text_that_is_no_chain_is_refused(text):
    refuses(text[:30], Noise.parse, text)
