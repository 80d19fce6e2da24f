"""What a run sees, at what rate, and where it ends; and that its budget can grow."""

import dataclasses
import itertools
import math

import pytest
import torch

import scenegen.model.training.loop
from scenegen.base.errors import DatasetError
from scenegen.model.checkpoint import CheckpointError, load_tensors
from scenegen.model.config import NetworkConfig, TrainConfig
from scenegen.model.training.course import Course
from scenegen.model.training.data import epoch_batches
from scenegen.model.training.run_folder import Progress
from tests.model.training.runs import SMALL, Counted, train

TINY = dataclasses.replace(SMALL, network=NetworkConfig(width=1, heads=1, variant="occ"), batch=12)


def course(count=80, **settings):
    return Course(Counted(count), TrainConfig(**settings))  # type: ignore[arg-type]


def rates(of, decay=None):
    return [of.rate(step, decay) for step in range(of.end(decay))]


def test_a_constant_rate_has_no_warm_up_and_ends_where_validation_stalls():
    steady = course(lr=2.0, epochs=10, patience=3, schedule="constant")
    assert set(rates(steady)) == {2.0}
    losses = [1.0, 0.5, 0.6, 0.6, 0.6]
    rounds = [steady.steps(Progress(rows=[{"val_loss": x} for x in losses[:n]])) for n in (4, 5)]
    assert rounds == [range(40, 50), range(0)]


@pytest.mark.parametrize("decay", [None, 1, 79])
def test_a_decay_stays_level_and_ends_at_nothing_wherever_it_begins(decay):
    of = course(lr=2.0, warmup_share=0.0, epochs=10, decay_share=0.2)
    found = rates(of, decay)
    begin = 80 if decay is None else decay
    assert of.latest_decay == 80
    assert found[: begin + 1] == [2.0] * (begin + 1)
    falls = [one - other for one, other in itertools.pairwise([*found[begin:], 0.0])]
    assert falls == pytest.approx([2.0 / len(falls)] * len(falls))
    assert len(falls) == math.ceil(begin / 4)


def test_a_budget_in_maps_replaces_passes():
    assert course(epochs=3).end(None) == 30
    assert course(epochs=3, maps=480).end(None) == 60
    assert course(maps=3).end(None) == 1
    assert course(count=5, maps=100).end(None) == 20


@pytest.mark.parametrize("interval", [None, 24, 200])
def test_rounds_see_the_passes_one_after_the_other(interval):
    of = course(count=83, maps=400, interval=interval)
    passes = [list(epoch_batches(Counted(83), TrainConfig(), epoch)) for epoch in range(5)]
    seen = [of.batches(first, min(of.round, 50 - first)) for first in range(0, 50, of.round)]
    assert list(itertools.chain(*seen)) == list(itertools.chain(*passes))
    assert list(of.batches(7, 9)) == list(itertools.chain(*passes))[7:16]


def validate_as(monkeypatch, *losses):
    """Validation finds these losses, one after the other."""
    found, said = scenegen.model.training.loop.validate, iter(losses)
    monkeypatch.setattr(
        scenegen.model.training.loop, "validate", lambda *of: found(*of) | {"loss": next(said)}
    )


def test_a_stall_begins_the_decay_and_the_run_ends_at_its_end(
    undrawn, folders, tmp_path, monkeypatch
):
    """Losses that never fall after round 2, and patience 2: the rate falls from round 5 on, over as
    many rounds."""
    validate_as(monkeypatch, 3.0, 2.0, *[2.5] * 20)
    config = dataclasses.replace(TINY, epochs=100, patience=2, decay_share=0.5)
    rows = train(folders, config, tmp_path / "run")
    steps = rows[0]["maps"]
    assert [row["maps"] / steps for row in rows] == list(range(1, 9))
    with pytest.raises(DatasetError, match="epochs is 100 there, 200 asked for"):
        train(folders, dataclasses.replace(config, epochs=200), tmp_path / "run")


def test_a_run_begins_with_given_weights_of_its_own_network(undrawn, folders, tmp_path):
    """With a rate of next to nothing, it ends with them."""
    once, still = (
        dataclasses.replace(TINY, epochs=1, lr=lr, seed=seed)
        for lr, seed in ((1e-2, 0), (1e-30, 1))
    )
    train(folders, once, tmp_path / "first")
    weights = tmp_path / "first" / "best.safetensors"
    train(folders, still, tmp_path / "second", weights=weights)
    first, second = (
        load_tensors(tmp_path / name / "best.safetensors")[0] for name in ("first", "second")
    )
    learned = [name for name in first if "running" not in name and "tracked" not in name]
    assert all(torch.equal(first[name], second[name]) for name in learned)
    with pytest.raises(CheckpointError, match=r"variant is .* there"):
        train(folders, SMALL, tmp_path / "third", weights=weights)
    with pytest.raises(DatasetError, match="begun with other settings"):
        train(folders, still, tmp_path / "second")
