"""A stream is the dataset without a disk, whoever draws it and in whatever order."""

import json
import os
import pickle
import signal
import threading
from dataclasses import replace

import numpy as np
import pytest

import scenegen
from scenegen.dataset.build import plan_dataset
from scenegen.draw.sample import Sample
from scenegen.draw.source import read_scenes
from scenegen.worlds.recipe import preset
from scenegen.worlds.traffic import PRESETS
from tests.command_line import python
from tests.conftest import small_recipe
from tests.refusals import refuses
from tests.scenegen import each_case
from tests.scenegen.conftest import built, same
from tests.scenegen.dataset import SCENE


def test_a_folder_of_scenes_is_dealt_as_generate_deals_it(tmp_path):
    (scenes := tmp_path / "scenes").mkdir()
    files = [scenes / f"{x}.xml" for x in range(4, 8)]
    for x, file in enumerate(files, start=4):
        file.write_text(SCENE.format(x=x))
    options = {"counts": {"train": 1, "val": 1, "test": 2}, "seed": 2}
    plan = plan_dataset(tmp_path / "d", preset("scene"), read_scenes(scenes, **options), **options)
    stored, stream = built(plan).split("test"), scenegen.stream(str(scenes), seed=2, split="test")
    assert all(same(stream[n], stored[n]) for n in range(2))
    for file in files[:2]:
        file.unlink()
    refuses("two", scenegen.stream, scenes)


def test_what_a_reader_does_to_a_sample_does_not_come_back():
    stream = scenegen.stream(small_recipe())
    first = stream[1]
    expected = pickle.loads(pickle.dumps(first))
    assert type(expected) is Sample
    for name in ("observed", "free", "occupancy", "tudf", "ranges", "position"):
        getattr(first, name)[:] = 0
    assert same(stream[1], expected)


def test_a_sample_depends_on_seed_split_and_number_alone():
    recipe = small_recipe()
    stream = scenegen.stream(recipe)
    for other in (scenegen.stream(recipe, seed=1), scenegen.stream(recipe, split="val")):
        assert other.digest != stream.digest
        assert not same(other[0], stream[0])
    again = scenegen.stream(recipe, seed=np.int64(0), samples=10**9, engine="mujoco")
    assert again.digest == stream.digest
    assert same(stream[123_456_789], again[123_456_789])


def test_parts_are_an_option_or_of_the_recipe():
    recipe = replace(small_recipe(), parts={"movers": PRESETS["light"]})
    asked = scenegen.stream(small_recipe(), movers="light")
    assert same(asked[0], scenegen.stream(recipe)[0])


def test_workers_make_what_one_process_makes_and_the_dead_are_replaced():
    recipe = small_recipe()
    alone = scenegen.stream(recipe, samples=45)
    helped = scenegen.stream(recipe, samples=45, workers=2)
    asking = threading.Thread(target=helped.__getitem__, args=(0,))
    asking.start()
    asking.join()
    begun = list(helped._ahead._given)
    for index in (*range(6), 40, 3, 41):
        assert same(helped[index], alone[index])
    assert list(helped._ahead._given) == begun
    for worker in helped._ahead._given:
        os.kill(worker.process.pid, signal.SIGKILL)
    assert all(same(one, other) for one, other in zip(helped[30:45], alone[30:45], strict=True))
    processes = [worker.process for worker in helped._ahead._given]
    assert same(pickle.loads(pickle.dumps(helped))[5], alone[5])
    helped.close()
    assert not any(process.is_alive() for process in processes)


def test_reading_goes_on_where_a_state_says():
    stream = scenegen.stream(small_recipe(), samples=5)
    reader = iter(stream)
    begun = [next(reader) for _ in range(2)]
    state = json.dumps(good := reader.state_dict())
    assert len(state) < 100
    resumed = iter(scenegen.stream(small_recipe(), samples=5))
    resumed.load_state_dict(json.loads(state))
    assert all(same(*pair) for pair in zip([*begun, *resumed], stream, strict=True))
    others = {"samples": good | {"samples": 6}, "stream": good | {"stream": "0"}}
    for case, wrong in (others | {"empty": {}, "none": None}).items():
        refuses(case, reader.load_state_dict, wrong)


def test_a_stream_that_nobody_closes_ends_without_a_word():
    """Also one that outlives the modules that it needs."""
    stream = "numpy.kept = scenegen.stream('pillar', workers=2); numpy.kept[0]"
    ended = python("-c", f"import numpy, scenegen; {stream}")
    assert ended.stdout == ""
    assert ended.stderr == ""


@each_case("streams/stream", "source options")
def test_what_cannot_be_ends_in_a_line(source, options):
    refuses(f"{source} {options}", scenegen.stream, json.loads(source), **json.loads(options))


def test_worlds_and_grids_that_cannot_be_mixed_end_in_a_line(tmp_path):
    (world := tmp_path / "world.xml").write_text(SCENE.format(x=4))
    refuses("twice", scenegen.stream, [world, world])
    refuses("grids", scenegen.stream, ["pillar", small_recipe()])
    refuses("no validation", scenegen.stream, str(world), split="val")


def test_an_index_that_is_none_ends_in_a_line(made):
    """Of a stream as of a dataset."""
    for samples in (scenegen.stream("pillar", samples=11), scenegen.load(made)):
        for wrong in (-12, 11):
            with pytest.raises(IndexError):
                samples[wrong]
        for wrong in (0.5, [1]):
            with pytest.raises(TypeError):
                samples[wrong]  # type: ignore[call-overload]
        assert samples[5:4] == []
