"""What is trained on need not lie on a disk: maps come in a stream's order, each once, and a run
can be resumed."""

import os

import pytest
import torch

import scenegen
from scenegen.base.errors import GenerationError, StoppedError
from scenegen.model.training import loop
from scenegen.model.training.data import Maps, load_batches, opened
from scenegen.model.training.loop import Watcher
from scenegen.model.training.schedule import Schedule
from scenegen.streams.mixture import Component
from tests.conftest import remembered, small_recipe
from tests.model.training.runs import SMALL, check_same, small
from tests.refusals import refuses

pytestmark = pytest.mark.usefixtures("undrawn")
CONFIG = small(maps=24, interval=8)


def streamed(split="train", samples=10**9):
    return scenegen.stream(
        [small_recipe("pillar"), small_recipe("geometric")], seed=1, split=split, samples=samples
    )


def run(out, **more):
    maps, validation = [streamed()], [streamed("val", 4)]
    return loop.train(maps, validation, CONFIG, out, device="cpu", **more)


def test_a_stopped_run_ends_where_an_uninterrupted_one_does(tmp_path, monkeypatch):
    monkeypatch.setattr("scenegen.dataset.shard.draw_unit", remembered)
    rows = run(tmp_path / "whole")
    assert [row["maps"] for row in rows] == [8, 16, 24]
    seen = []
    watcher = Watcher(on_step=lambda maps, loss: seen.append(maps), stop=lambda: sum(seen) >= 12)
    with pytest.raises(StoppedError):
        run(tmp_path / "parts", watcher=watcher)
    run(tmp_path / "parts", workers=1)
    check_same(tmp_path / "whole", tmp_path / "parts")


def test_maps_are_the_streams_each_once_and_turned_by_seed():
    stream = streamed()
    maps = Maps([stream], "train")
    schedule = Schedule(maps, CONFIG)
    batches = list(schedule.batches(0, 48))
    assert list(schedule.batches(5, 3)) == batches[5:8]
    seen = [index for batch in batches for index, _ in batch]
    assert sorted(seen) == list(range(4 * 48))
    assert len({turn for batch in batches for _, turn in batch}) == 8
    assert list(Schedule(maps, small(maps=24, interval=8, seed=1)).batches(0, 48)) != batches
    expected = torch.from_numpy(stream[seen[0]].occupancy)
    assert torch.equal(maps[seen[0], 0]["occupancy"], expected)


@pytest.mark.parametrize("workers", [0, 2])
def test_no_loader_process_draws_what_another_draws(workers, tmp_path, monkeypatch):
    """A file tells of every unit, and of the process that draws it."""
    original = Component.draw

    def draw(component, unit):
        (tmp_path / f"{component.recipe.kind} {unit} {os.getpid()}").touch(exist_ok=False)
        return original(component, unit)

    monkeypatch.setattr(Component, "draw", draw)
    maps = Maps([streamed()], "train")
    batches = list(Schedule(maps, CONFIG).batches(3, 20))
    read = load_batches(maps, batches, workers=workers, pinned=False)
    assert sum(len(one["occupancy"]) for one in read) == 80
    drawn = [path.name.split() for path in tmp_path.iterdir()]
    assert len({(kind, unit) for kind, unit, _ in drawn}) == len(drawn)
    assert len({process for _, _, process in drawn}) == max(workers, 1)


def test_unfit_streams_are_refused(folders, monkeypatch):
    maps = Maps([streamed()], "train")
    refuses("endless", Schedule, maps, SMALL)
    mixed = Maps([streamed(), *opened(folders[:1], "train")], "train")
    refuses("with a dataset", Schedule, mixed, CONFIG)

    def hopeless(component, unit):
        raise GenerationError("train world 0: all draws rejected")

    monkeypatch.setattr(Component, "draw", hopeless)
    for workers in (0, 1):
        batches = load_batches(maps, [[0]], workers=workers, pinned=False)
        refuses(workers, list, batches)
