"""What is trained on need not lie on a disk: maps come in a stream's order, each once, and a run
can be resumed."""

import dataclasses
import os

import pytest
import torch
from torch.utils.data import DataLoader

import scenegen
import scenegen.model.training.loop
from scenegen.base.errors import DatasetError, GenerationError, StoppedError
from scenegen.model.training.course import Course
from scenegen.model.training.data import Maps, load, opened
from scenegen.model.training.loop import Watcher
from scenegen.streams.mixture import Component
from tests.conftest import remembered, small_recipe
from tests.model.training.runs import SMALL, check_same
from tests.scenegen.streams.test_stream import same

pytestmark = pytest.mark.usefixtures("undrawn")
CONFIG = dataclasses.replace(SMALL, maps=24, interval=8)


def streamed(split="train", samples=10**9):
    return scenegen.stream(
        [small_recipe("pillar"), small_recipe("geometric")], seed=1, split=split, samples=samples
    )


def run(out, **more):
    checking = [streamed("val", 4)]
    return scenegen.model.training.loop.train(
        [streamed()], checking, CONFIG, out, device="cpu", **more
    )  # type: ignore[arg-type]


@pytest.fixture
def drawers(tmp_path, monkeypatch):
    """A folder with a file for every unit and process that draws it."""
    folder, original = tmp_path / "drawers", Component.draw
    folder.mkdir()

    def draw(component, unit):
        (folder / f"{component.recipe.kind} {unit} {os.getpid()}").touch(exist_ok=False)
        return original(component, unit)

    monkeypatch.setattr(Component, "draw", draw)
    return folder


def test_a_stopped_run_ends_where_an_uninterrupted_one_does(tmp_path, monkeypatch):
    monkeypatch.setattr("scenegen.dataset.shard.draw_unit", remembered)
    rows = run(tmp_path / "whole")
    assert [row["maps"] for row in rows] == [8, 16, 24]
    seen = 0

    def count(maps, loss):
        nonlocal seen
        seen += maps

    with pytest.raises(StoppedError):
        run(tmp_path / "parts", watcher=Watcher(on_step=count, stop=lambda: seen >= 12))
    run(tmp_path / "parts", workers=1)
    check_same(tmp_path / "whole", tmp_path / "parts")


def test_maps_are_the_streams_each_once_and_turned_by_seed():
    stream = streamed()
    maps = Maps([stream], "train")
    course = Course(maps, CONFIG)
    batches = list(course.batches(0, 48))
    assert list(course.batches(5, 3)) == batches[5:8]
    seen = [index for batch in batches for index, _ in batch]
    assert sorted(seen) == list(range(4 * 48))
    assert len({turn for batch in batches for _, turn in batch}) == 8
    assert list(Course(maps, dataclasses.replace(CONFIG, seed=1)).batches(0, 48)) != batches
    found = maps[batches[0][0][0], 0]
    assert torch.equal(found["occupancy"], torch.from_numpy(stream[batches[0][0][0]].occupancy))


@pytest.mark.parametrize("workers", [0, 2])
def test_no_loader_process_draws_what_another_draws(workers, drawers):
    maps = Maps([streamed()], "train")
    batches = list(Course(maps, CONFIG).batches(3, 20))
    read = load(maps, batches, workers=workers, pinned=False)
    assert sum(len(one["occupancy"]) for one in read) == 80
    drawn = [path.name.split() for path in drawers.iterdir()]
    assert len({(kind, unit) for kind, unit, _ in drawn}) == len(drawn)
    assert len({process for _, _, process in drawn}) == max(workers, 1)


def test_torchs_own_conventions_hold():
    """With workers of its own in the main process, which torch's may not have, and without."""
    expected = streamed()
    helped = scenegen.stream(expected.mixture.components, seed=1, samples=24, workers=1)
    helped[0]
    for processes in (0, 2):
        loader = DataLoader(helped, batch_size=6, num_workers=processes, collate_fn=list)
        assert len(loader) == 4
        read = [sample for batch in loader for sample in batch]
        assert all(same(one, expected[n]) for n, one in enumerate(read))
    helped.close()


def test_what_cannot_be_trained_on_ends_in_a_line(folders, monkeypatch):
    maps = Maps([streamed()], "train")
    with pytest.raises(DatasetError, match="say how many maps to see with --maps"):
        Course(maps, SMALL)
    with pytest.raises(DatasetError, match="is trained on alone"):
        Course(Maps([streamed(), *opened(folders[:1], "train")], "train"), CONFIG)

    def hopeless(component, unit):
        raise GenerationError("train world 0: all draws rejected")

    monkeypatch.setattr(Component, "draw", hopeless)
    for workers in (0, 1):
        with pytest.raises(GenerationError, match=r"^train world 0: all draws rejected$"):
            list(load(maps, [[0]], workers=workers, pinned=False))
