"""A stream is the dataset without a disk, whoever draws it and in whatever order."""

import json
import os
import pickle
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest

import scenegen
from scenegen import SPLITS
from scenegen.dataset.build import plan_dataset
from scenegen.draw.sample import Sample
from scenegen.draw.source import DrawnWorlds, read_scenes
from scenegen.worlds.recipe import preset
from tests.command_line import ROOT, rows
from tests.conftest import dataset_in, picky_recipe, small_recipe
from tests.scenegen import refuses
from tests.scenegen.conftest import built, same

SCENES = ROOT / "scenes"


@pytest.mark.parametrize(
    "recipe", [picky_recipe(), small_recipe("geometric", noise={"stages": "grazing"})]
)
def test_its_first_samples_are_those_of_the_dataset(recipe, tmp_path):
    """The picky recipe rejects some draws of most units."""
    counts = {"train": 5, "val": 1, "test": 2}
    made = dataset_in(tmp_path / "d", recipe, seed=5, counts=counts, shard_samples=3)
    for split in SPLITS:
        stored, drawn = made.split(split), scenegen.stream(recipe, seed=5, split=split)
        assert drawn.describe() == stored.describe()
        order = np.random.default_rng(0).permutation(counts[split])
        assert all(same(drawn[int(n)], stored[int(n)]) for n in order)
    if recipe.kind == "pillar":
        assert sum(made.manifest.rejected["worlds"].values()) > 0


def test_a_folder_of_scenes_is_dealt_as_generate_deals_it(tmp_path):
    drawn, scenes = DrawnWorlds(small_recipe()), tmp_path / "scenes"
    scenes.mkdir()
    for number in range(4):
        world = drawn.world("train", number, rng=np.random.default_rng(number))
        (scenes / f"{number}.xml").write_bytes(world.mjcf)
    asked = {"seed": 2, "counts": {"train": 1, "val": 1, "test": 2}}
    source = read_scenes(scenes, asked["counts"], seed=2)
    stored = built(plan_dataset(tmp_path / "d", preset("scene"), source, **asked)).split("test")
    stream = scenegen.stream(str(scenes), seed=2, split="test")
    assert all(same(stream[n], stored[n]) for n in range(2))
    for number in range(2):
        (scenes / f"{number}.xml").unlink()
    refuses("fewer than 3 worlds", scenegen.stream, scenes)


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
    state = json.dumps(reader.state_dict())
    assert len(state) < 100
    resumed = iter(scenegen.stream(small_recipe(), samples=5))
    resumed.load_state_dict(json.loads(state))
    everything = zip([*begun, *resumed], stream, strict=True)
    assert all(same(one, other) for one, other in everything)
    good = json.loads(state)
    for wrong in (good | {"samples": 6}, good | {"stream": "0"}, {}, None):
        refuses(r"^state of a stream: ", reader.load_state_dict, wrong)


def test_a_stream_that_nobody_closes_ends_without_a_word():
    """Also one that outlives the modules that it needs."""
    code = (
        "import numpy, scenegen; numpy.kept = scenegen.stream('pillar', workers=2); numpy.kept[0]"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, b"", b"")


FOREST = SCENES / "forest.xml"
WRONG = """
"pilar"                          → {}                  → unknown kind 'pilar'.*'pillar'
[]                               → {}                  → nothing to draw from
3                                → {}                  → expected a kind's name
{"pillar": 0}                    → {}                  → weight of pillar = 0: expected a
{"pillar": NaN}                  → {}                  → weight of pillar = nan
{"pillar": 1e-9, "geometric": 1} → {}                  → come round after 1000000001 flights
"pillar"                         → {"engine": "cuda3"} → cuda3
"absent.xml"                     → {}                  → no such file
"""
WRONG = [(json.loads(asked), json.loads(options), said) for asked, options, said in rows(WRONG)]


@pytest.mark.parametrize(
    ("asked", "options", "said"),
    [
        *WRONG,
        ([FOREST] * 2, {}, "is there twice"),
        (["pillar", small_recipe()], {}, "one grid"),
        (str(FOREST), {"split": "val"}, "no world of it is in the val split"),
    ],
)
def test_what_cannot_be_ends_in_a_line(asked, options, said):
    refuses(said, scenegen.stream, asked, **options)


def test_an_index_that_is_none_ends_in_a_line(made):
    """Of a stream as of a dataset."""
    for samples in (scenegen.stream("pillar", samples=11), scenegen.load(made)):
        for wrong in (-12, 11):
            with pytest.raises(IndexError, match="has no sample"):
                samples[wrong]
        for wrong in (0.5, [1]):
            with pytest.raises(TypeError, match="as an integer"):
                samples[wrong]  # type: ignore[call-overload]
        assert samples[5:4] == []
