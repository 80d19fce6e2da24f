"""Samples that are merged or taken stay what they were, and known by where they are from."""

import dataclasses
import shutil

import numpy as np
import pytest
from scenegen.dataset.choose import Choice, Condition
from scenegen.dataset.gather import plan_merge, plan_take
from scenegen.dataset.rescan import plan_rescan
from scenegen.dataset.rules import Numbering

from lidarsim.noise.chain import Noise
from scenegen import SPLITS
from scenegen.dataset import manifest
from scenegen.dataset.build import build, plan_dataset
from scenegen.dataset.read import Dataset
from scenegen.dataset.schema import NAME
from scenegen.errors import DatasetError, PublishError
from scenegen.share.stage import Request, examine
from scenegen.source import read_scenes
from scenegen.verification import verify
from tests.command_line import rows
from tests.conftest import COUNTS, contents, dataset_in, scene_recipe, small_recipe, stop_at_val
from tests.scenegen.conftest import built, same
from tests.scenegen.verification import forge
from tests.scenegen.verification.conftest import failed

WORLD = """<mujoco><worldbody><geom name="floor" type="plane" size="8 8 .1" pos="8 8 0"/>
<geom type="cylinder" size=".4 2" pos="{x} 6 2"/><geom type="box" size=".5 .5 2" pos="9 {x} 2"/>
<geom type="box" size="8 8 .1" pos="8 8 -.1"/></worldbody></mujoco>"""


def make(folder, seed, **tables):
    recipe = small_recipe(**tables)
    return dataset_in(folder, recipe, seed=seed, counts=COUNTS, shard_samples=3).folder


@pytest.fixture(scope="session")
def first(once):
    """A dataset; not to be changed."""
    return once("gather-first", lambda folder: make(folder, 1))


@pytest.fixture(scope="session")
def second(once):
    """One of other worlds; not to be changed."""
    return once("gather-second", lambda folder: make(folder, 2))


def merged(out, *folders, workers=1):
    plan = plan_merge([Dataset(one) for one in folders], out, workers=workers)
    return built(plan, workers=workers)


def taken(out, folder, **choice):
    return built(plan_take(Dataset(folder), out, Choice(**choice)))


def who(dataset):
    """Every sample by what it shows and its split, and the bytes of its world."""
    return {
        (sample.ranges.tobytes() + sample.position.tobytes(), split): dataset.world(
            split, sample.world
        )["world.xml"]
        for split in SPLITS
        for sample in dataset.split(split)
    }


def sound(folder):
    report = verify(folder)
    assert report.ok, [check for check in report.checks if not check.ok]
    return {check.name: check for check in report.checks}


@pytest.mark.parametrize("scenes", [None, 1, 4])
def test_a_samples_place_is_known_by_its_name_and_its_name_by_its_place(scenes):
    numbering, places = Numbering(viewpoints=3, scenes=scenes), np.arange(50)
    world, viewpoint = numbering.name(places)
    assert (numbering.place(world, viewpoint) == places).all()
    assert len(set(zip(world.tolist(), viewpoint.tolist(), strict=True))) == 50
    for start in range(12):
        assert numbering.count(start) == len(set(world[:start].tolist()))


def test_a_merged_dataset_holds_all_samples_as_they_were(first, second, tmp_path):
    found = merged(tmp_path / "m", first, second)
    assert manifest.read(tmp_path / "m")["version"] == 1.4
    assert who(found) == who(Dataset(first)) | who(Dataset(second))
    for split in SPLITS:
        before = [sample for folder in (first, second) for sample in Dataset(folder).split(split)]
        samples = found.split(split)
        assert len(samples) == len(before)
        for n, (sample, was) in enumerate(zip(samples, before, strict=True)):
            assert same(sample, dataclasses.replace(was, world=sample.world))
            assert samples.home(n).seed == (1 if n < COUNTS[split] else 2)
        assert len(set(samples.names)) == len(samples)
        assert samples.count_worlds() == len({world for _, world, _ in samples.names})
    checks = sound(tmp_path / "m")
    assert not any(check.skipped for check in checks.values())
    assert checks["regenerated"].counts["worlds"] == len(found.manifest.shards)


SAYS = """
kind     → "maze"    → kind = 'maze': expected 'pillar', as its sources say
seed     → 3         → seed = 3: expected None
recipe   → {"flight": {}, "accept": {}, "version": 1} → recipe =
software → {}        → software = {}: expected
rescan   → {"digest": "0000000000000000000000000000000000000000000000000000000000000000"} → rescan =
"""


@pytest.mark.parametrize(("path", "value", "told"), rows(SAYS))
def test_what_a_merged_dataset_says_of_its_sources_is_checked(
    first, second, tmp_path, path, value, told
):
    folder = merged(tmp_path / "m", first, second).folder
    forge.edit_at(folder, path, value)
    assert told in failed(folder, quick=True)["manifest"]


def test_workers_and_interruptions_change_no_byte(first, second, tmp_path):
    merged(tmp_path / "m", first, second)
    merged(tmp_path / "two", first, second, workers=2)
    plan = plan_merge([Dataset(first), Dataset(second)], tmp_path / "cut")

    with pytest.raises(KeyboardInterrupt):
        build(plan, on_shard=stop_at_val)
    with pytest.raises(DatasetError, match="incomplete"):
        Dataset(plan.folder)
    assert 0 < build(plan).samples_written < sum(COUNTS.values()) * 2
    assert contents(tmp_path / "m") == contents(tmp_path / "two") == contents(plan.folder)


def test_what_is_taken_is_what_a_plain_loop_would_take(first, second, tmp_path):
    whole = merged(tmp_path / "m", first, second)
    level = float(np.median([sample.occupancy.mean() for sample in whole.split("train")]))
    where = (Condition("occupied", ">=", level), Condition("sample", "<", 20))
    found = taken(tmp_path / "t", tmp_path / "m", most=7, worlds=((0, 3), (4, 7)), where=where)
    for split in SPLITS:
        asked = [
            one
            for one in whole.split(split)[:20]
            if one.occupancy.mean() >= level and one.world in (0, 1, 2, 4, 5, 6)
        ][:7]
        samples = found.split(split)
        assert [one.ranges.tobytes() for one in samples] == [one.ranges.tobytes() for one in asked]
        assert samples.count_worlds() == len({one.world for one in asked})
    assert who(found).items() <= who(whole).items()
    assert any(entry.cut for entry in found.manifest.shards)  # type: ignore[attr-defined]
    said = f"--n 7 --worlds 0:3,4:7 --where occupied>={level} --where sample<20"
    assert [it["taken"] for it in manifest.read(tmp_path / "t")["sources"]] == [[said]] * 2
    sound(tmp_path / "t")


def test_what_was_taken_apart_can_be_merged_again(first, tmp_path):
    for name, sign in (("a", "<"), ("b", ">=")):
        taken(tmp_path / name, first, where=(Condition("viewpoint", sign, 1.0),))
    found, there = merged(tmp_path / "m", tmp_path / "a", tmp_path / "b"), Dataset(first)
    assert who(found) == who(there)
    (source,) = manifest.read(tmp_path / "m")["sources"]
    assert source["taken"] == ["--where viewpoint<1", "--where viewpoint>=1"]
    names = ({name[1:] for name in one.split("train").names} for one in (found, there))
    assert next(names) == next(names)
    # its samples lie here in another order
    assert sound(tmp_path / "m")["digest"].counts["sources"] == 1


def test_one_split_keeps_its_files_and_its_names(first, tmp_path):
    found, there = taken(tmp_path / "t", first, splits=("test",)), Dataset(first)
    assert [len(found.split(split)) for split in SPLITS] == [0, 0, COUNTS["test"]]
    assert found.split("test").names == there.split("test").names
    for entry in found.manifest.shards:
        assert (tmp_path / "t" / entry.file).read_bytes() == (first / entry.file).read_bytes()
    assert (found.manifest.kind, found.manifest.seed) == ("pillar", 1)
    with pytest.raises(DatasetError, match="scan those again"):
        plan_rescan(found, tmp_path / "again")
    with pytest.raises(PublishError, match="publish a dataset of each"):
        examine(Request(dataset=found.folder, repository="ada/x", out=tmp_path / "p"))


def test_a_dataset_scanned_again_is_verified_as_far_as_its_flights_go(first, tmp_path):
    build(plan_rescan(Dataset(first), tmp_path / "again", chain=Noise.parse("range:0.02")))
    taken(tmp_path / "t", tmp_path / "again", where=(Condition("viewpoint", "=", 1.0),))
    checks = sound(tmp_path / "t")
    assert "no flight" in checks["regenerated"].detail
    assert manifest.read(tmp_path / "t")["version"] == 1.4, (
        "the later of what noise and sources ask"
    )
    taken(tmp_path / "u", tmp_path / "again", most=2)
    assert not sound(tmp_path / "u")["regenerated"].skipped


def test_worlds_from_files_are_merged_where_they_are_in_one_split(tmp_path):
    for n in range(3):
        (tmp_path / f"{n}.xml").write_text(WORLD.format(x=4 + n))

    def scenes(name, path, seed, **counts):
        source = read_scenes(path, counts, seed=seed)
        asked = {"seed": seed, "counts": counts, "shard_samples": 3}
        return built(plan_dataset(tmp_path / name, scene_recipe(), source, **asked))

    dealt = scenes("dealt", tmp_path, 0, train=5, val=2, test=2)
    trained, tested = (
        scenes(split, tmp_path / its[0]["file"], 5, train=6, val=0, test=0)
        for split, its in dealt.manifest.tables["scenes"].items()
        if split != "val"
    )
    both = merged(tmp_path / "m", dealt.folder, trained.folder)
    assert sum(len(both.split(split)) for split in SPLITS) == 15
    with pytest.raises(DatasetError, match="two splits"):
        plan_merge([dealt, tested], tmp_path / "n")
    part = taken(
        tmp_path / "t", dealt.folder, splits=("train",), where=(Condition("sample", ">", 0.0),)
    )
    assert len(part.split("train")) == 4
    sound(tmp_path / "t")


def test_a_sample_under_two_names_is_merged_once(tmp_path):
    """A world from a file has another number where it is alone, and the same flights."""
    (tmp_path / "scenes").mkdir()
    for n in range(3):
        (tmp_path / "scenes" / f"{n}.xml").write_text(WORLD.format(x=4 + n))

    def scenes(name, path, **tables):
        source = read_scenes(path, counts := {"train": 9, "val": 0, "test": 0}, seed=0)
        recipe = dataclasses.replace(scene_recipe(), **tables)
        return built(plan_dataset(tmp_path / name, recipe, source, seed=0, counts=counts))

    every = scenes("all", tmp_path / "scenes")
    for n in range(3):
        alone = scenes(f"{n}", tmp_path / "scenes" / f"{n}.xml")
        with pytest.raises(DatasetError, match=r"all/train.*: hold the same sample"):
            plan_merge([every, alone], tmp_path / "m")
        # what another sensor sees from the same pose is another sample
        noisy = scenes(f"noisy-{n}", tmp_path / "scenes" / f"{n}.xml", noise=Noise.parse("range"))
        assert len(merged(tmp_path / f"m{n}", every.folder, noisy.folder).split("train")) == 18
        sound(tmp_path / f"m{n}")


WRONG = """
sources                                       → []      → sources
sources                                       →         → version = 1.4
sources.0.digest                              →         → digest is missing
sources.0.parameters.sources                  → []      → expected none
sources.0.parameters.grid.voxel               → 0.3     → parameters.grid
sources.0.parameters.recipe.flight.viewpoints →         → viewpoints is missing
shards.0.source                               → 7       → source = 7
shards.0.stop                                 → 1000000 → places
shards.0.start                                →         → start is missing
"""


@pytest.mark.parametrize(("path", "value", "told"), rows(WRONG))
def test_a_strangers_sources_are_not_trusted(first, tmp_path, path, value, told):
    folder = taken(tmp_path / "t", first, splits=("val",)).folder
    forge.edit_at(folder, path, value)
    with pytest.raises(DatasetError, match=told):
        Dataset(folder)
    assert not verify(folder, quick=True).ok


def test_a_false_account_of_where_samples_are_from_does_not_pass(first, second, tmp_path):
    merged(tmp_path / "m", first, second)
    shards = manifest.read(tmp_path / "m")["shards"]
    for wrong in ({"source": 1}, {"start": 3, "stop": 6}, {"start": 0, "stop": 6}):
        forge.edit_manifest(tmp_path / "m", shards=[shards[0] | wrong, *shards[1:]])
        assert not verify(tmp_path / "m", quick=True).ok, wrong


def test_a_sources_digest_is_held_against_its_samples_where_all_are_there(first, second, tmp_path):
    taken(tmp_path / "part", second, where=(Condition("viewpoint", "<", 1.0),))
    merged(tmp_path / "m", first, tmp_path / "part")
    assert "only a part of their samples is there" in sound(tmp_path / "m")["digest"].detail
    whole, part = manifest.read(tmp_path / "m")["sources"]
    wrong = {"digest": "0" * 64}
    for sources, failing in (([whole | wrong, part], ["digest"]), ([whole, part | wrong], [])):
        forge.edit_manifest(tmp_path / "m", sources=sources)
        assert list(failed(tmp_path / "m", quick=True)) == failing


def test_a_sample_is_not_there_twice(first, tmp_path):
    folder = taken(tmp_path / "t", first, splits=("train",)).folder
    there = manifest.read(folder)
    last = there["shards"][-1]
    again = last | {"file": "train-00009.h5", "worlds": "train-00009.worlds.zip"}
    for name in ("file", "worlds"):
        shutil.copy(folder / last[name], folder / again[name])
    counts = there["counts"] | {"train": there["counts"]["train"] + again["samples"]}
    forge.edit_manifest(folder, shards=[*there["shards"], again], counts=counts)
    assert "are there twice" in failed(folder, quick=True)["digest"]


def moved(arrays):
    for name in ("position", "origin"):
        arrays[name] = arrays[name] + 0.05


@pytest.mark.parametrize(
    ("change", "signed", "said"),
    [
        (moved, False, "train-00000.h5: is not the file"),
        (moved, True, "train-00000.h5: sample 0: its content does not have the digest"),
        (None, False, "train-00000.worlds.zip: is not the file"),
    ],
)
def test_nothing_is_made_of_samples_that_are_not_what_their_dataset_says(
    first, second, tmp_path, change, signed, said
):
    folder = forge.copy(first, tmp_path / "bad")
    listed = (folder / NAME).read_bytes()
    if change is None:
        more = {"000009.xml": b"<mujoco/>"}
        forge.rezip(folder / "train-00000.worlds.zip", lambda members: members.update(more))
    else:
        arrays, attributes = forge.load(folder, "train-00000.h5")
        change(arrays)
        forge.store(folder, "train-00000.h5", arrays, attributes, digests=False)
    if not signed:
        (folder / NAME).write_bytes(listed)
    bad = Dataset(folder)
    plans = [
        plan_rescan(bad, tmp_path / "rescan"),
        plan_take(bad, tmp_path / "part", Choice(most=2)),
        plan_take(bad, tmp_path / "whole", Choice(splits=("train",))),
        plan_merge([Dataset(second), bad], tmp_path / "merge"),
    ]
    # a whole shard is copied by its file's sum, and `verify` sees into it
    for plan in plans[: 2 if signed else 4]:
        with pytest.raises(DatasetError, match=said):
            build(plan)


def test_datasets_that_do_not_go_together_are_refused(first, second, tmp_path):
    def refused(*folders):
        with pytest.raises(DatasetError) as error:
            plan_merge([Dataset(one) for one in folders], tmp_path / "m")
        assert not (tmp_path / "m").exists()
        return str(error.value)

    assert "hold the same sample" in refused(first, second, first)
    other = make(tmp_path / "other", 3, grid={"shape": (16, 16, 16)})
    assert f"{other}: grid.shape is [16, 16, 16] there" in refused(first, other)
    for out in (first, first / "in" / "it"):
        with pytest.raises(DatasetError, match="itself, or in it"):
            plan_take(Dataset(first), out, Choice())
    with pytest.raises(DatasetError, match="no sample is as asked for"):
        plan_take(Dataset(first), tmp_path / "t", Choice(where=(Condition("occupied", ">", 2.0),)))
    taken(tmp_path / "t", first, where=(Condition("viewpoint", "<", 1.0),))
    (tmp_path / "t" / NAME).unlink()
    with pytest.raises(DatasetError, match="no dataset"):  # shards do not tell which samples
        taken(tmp_path / "t", first, where=(Condition("viewpoint", "=", 1.0),))


@pytest.mark.parametrize("text", ["occupied", ">3", "weight>3", "occupied>>3", "free=1e"])
def test_a_condition_that_cannot_be_read_is_refused_in_one_line(text):
    with pytest.raises(ValueError, match="expected a name, a sign and a number") as error:
        Condition.of(text)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("sign", "held"), [("<", ".4"), ("<=", ".4 .5"), (">", ".6"), (">=", ".5 .6"), ("=", ".5")]
)
def test_a_condition_says_what_its_sign_says(sign, held):
    condition = Condition.of(f" range_m {sign} 1000001.5 ")
    assert Condition.of(str(condition)) == condition
    ends = ".4", ".5", ".6", "nan"
    assert [end for end in ends if condition.holds(1000001 + float(end))] == held.split()
