"""What a run sees, at what rate, and where it ends; and that its budget can grow."""

import itertools
import math

import pytest
import torch

from scenegen.model.checkpoint import load_network, load_tensors
from scenegen.model.config import NetworkConfig, TrainConfig
from scenegen.model.training import loop
from scenegen.model.training.data import epoch_batches
from scenegen.model.training.run_folder import Progress
from scenegen.model.training.schedule import Schedule
from tests.model.training.runs import SMALL, Counted, small, train
from tests.refusals import refuses

TINY = {"network": NetworkConfig(width=1, heads=1, variant="occ"), "batch": 12}


def schedule_of(count=80, **settings):
    return Schedule(Counted(count), TrainConfig(**settings))  # type: ignore[arg-type]


def rates(schedule, decay=None):
    return [schedule.rate(step, decay) for step in range(schedule.end(decay))]


def test_constant_rates_end_where_validation_stalls():
    steady = schedule_of(lr=2.0, epochs=10, patience=3, schedule="constant")
    assert set(rates(steady)) == {2.0}
    rows = [{"val_loss": loss} for loss in (1.0, 0.5, 0.6, 0.6, 0.6)]
    rounds = [steady.steps(Progress(rows=rows[:n])) for n in (4, 5)]
    assert rounds == [range(40, 50), range(0)]


@pytest.mark.parametrize("decay", [None, 1, 79])
def test_a_decay_is_linear_wherever_it_begins(decay):
    decaying = schedule_of(lr=2.0, warmup_share=0.0, epochs=10, decay_share=0.2)
    actual = rates(decaying, decay)
    begin = 80 if decay is None else decay
    assert decaying.latest_decay == 80
    assert actual[: begin + 1] == [2.0] * (begin + 1)
    falls = [rate - after for rate, after in itertools.pairwise([*actual[begin:], 0.0])]
    assert falls == pytest.approx([2.0 / len(falls)] * len(falls))
    assert len(falls) == math.ceil(begin / 4)


def test_a_budget_in_maps_replaces_passes():
    budgets = {"epochs": 3}, {"epochs": 3, "maps": 480}, {"maps": 3}, {"count": 5, "maps": 100}
    assert [schedule_of(**budget).end(None) for budget in budgets] == [30, 60, 1, 20]


@pytest.mark.parametrize("interval", [None, 24, 200])
def test_rounds_see_one_pass_after_another(interval):
    run = schedule_of(count=83, maps=400, interval=interval)
    passes = [list(epoch_batches(Counted(83), TrainConfig(), epoch)) for epoch in range(5)]
    expected = list(itertools.chain(*passes))
    rounds = [run.batches(first, min(run.round, 50 - first)) for first in range(0, 50, run.round)]
    assert list(itertools.chain(*rounds)) == expected
    assert list(run.batches(7, 9)) == expected[7:16]


def test_a_stall_begins_the_decay(undrawn, folders, tmp_path, monkeypatch):
    """Losses that never fall after round 2, and patience 2: the rate falls from round 5 on, over as
    many rounds. Of rounds that are equal, the first is the best."""
    validate, losses = loop.validate, iter([3.0, 2.0, 2.0, *[2.5] * 20])
    monkeypatch.setattr(loop, "validate", lambda *given: validate(*given) | {"loss": next(losses)})
    settings = TINY | {"patience": 2, "decay_share": 0.5}
    rows = train(folders, small(**settings, epochs=100), tmp_path / "run")
    assert [row["maps"] / rows[0]["maps"] for row in rows] == list(range(1, 9))
    assert load_network(tmp_path / "run" / "best.safetensors")[2]["figures"]["epoch"] == 2
    longer = small(**settings, epochs=200)
    refuses("longer", train, folders, longer, tmp_path / "run")


def test_a_run_begins_with_given_weights(undrawn, folders, tmp_path):
    """With a rate of next to nothing, it ends with them."""
    fast, slow = (small(**TINY, epochs=1, lr=lr, seed=seed) for lr, seed in ((1e-2, 0), (1e-30, 1)))
    train(folders, fast, tmp_path / "first")
    weights = tmp_path / "first" / "best.safetensors"
    train(folders, slow, tmp_path / "second", weights=weights)
    first, second = (
        load_tensors(tmp_path / name / "best.safetensors")[0] for name in ("first", "second")
    )
    learned = [name for name in first if "running" not in name and "tracked" not in name]
    assert all(torch.equal(first[name], second[name]) for name in learned)
    refuses("variant", train, folders, SMALL, tmp_path / "third", weights=weights)
    refuses("weights", train, folders, slow, tmp_path / "second")
