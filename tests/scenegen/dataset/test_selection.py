"""Selections: what is taken is what a plain loop takes, and what is read is what was chosen."""

import contextlib
import hashlib
import json
import shutil

import numpy as np
import pytest

from scenegen import SPLITS
from scenegen.base.errors import DatasetError
from scenegen.dataset.collection import open_data
from scenegen.dataset.read import Dataset
from scenegen.dataset.selection import (
    COLUMNS,
    DIGEST_BYTES,
    MEASURES,
    SIGNS,
    Condition,
    SelectionCriteria,
    choose,
    encode_measures,
    encode_selection,
    kept_measures,
    measures_file,
)
from scenegen.view.inspect import inspect
from tests.command_line import done
from tests.conftest import COUNTS, dataset_in, small_recipe
from tests.refusals import refuses
from tests.scenegen import each_case
from tests.scenegen.dataset import NASTY, put, samples_of


@pytest.fixture(scope="session")
def two_kinds(once):
    """A folder of datasets of two kinds; not to be changed."""

    def make(folder):
        for seed, kind in enumerate(("pillar", "geometric")):
            options = {"seed": seed, "counts": COUNTS, "shard_samples": 6}
            dataset_in(folder / kind, small_recipe(kind), **options)

    return once("two_kinds", make)


@pytest.fixture(scope="session")
def measured(once, two_kinds):
    """The same with its measures beside it; not to be changed."""

    def make(folder):
        for member in open_data(shutil.copytree(two_kinds, folder, dirs_exist_ok=True)).datasets:
            inspect(member, keep=True)

    return once("two_kinds_measured", make)


@pytest.fixture
def folder(two_kinds, tmp_path):
    """A copy of the first, to change."""
    return shutil.copytree(two_kinds, tmp_path / "two_kinds")


@pytest.fixture
def written(folder, tmp_path):
    """The file of a selection of pillar's samples, whose dataset may be changed."""
    dataset = Dataset(folder / "pillar")
    criteria = SelectionCriteria(splits=("train",), where=(Condition.of("viewpoint<2"),))
    file = tmp_path / "few.json"
    file.write_bytes(encode_selection(dataset, choose(dataset, criteria), criteria, tmp_path))
    return file


def lists(numbers):
    return {name: values.tolist() for name, values in numbers.items()}


def with_conditions(*texts, **more):
    return SelectionCriteria(**more | {"where": tuple(map(Condition.of, texts))})


def plain_loop(dataset, criteria):
    """What a loop over all samples takes."""
    taken, worlds = {}, criteria.worlds or ((0, 99),)
    for name in criteria.splits:
        split, numbers = dataset.split(name), []
        for number, sample in enumerate(split):
            names = {it.name for it in criteria.where} & MEASURES.keys()
            values = {name: MEASURES[name](sample) for name in names}
            values |= {"sample": number, "world": sample.world, "viewpoint": sample.viewpoint}
            kind = split.home(number).graded
            if (
                kind in (criteria.kinds or (kind,))
                and any(first <= sample.world < stop for first, stop in worlds)
                and all(SIGNS[it.sign](values[it.name], it.value) for it in criteria.where)
            ):
                numbers.append(number)
        taken[name] = numbers[: criteria.most]
    return taken


@pytest.mark.parametrize("name", ["two_kinds", "measured"])
@each_case("dataset/choices", "settings", json.loads)
def test_what_is_chosen_is_what_a_plain_loop_takes(settings, name, request):
    dataset = open_data(request.getfixturevalue(name))
    assert bool(kept_measures(dataset)) == (name == "measured")
    criteria = with_conditions(*settings.get("where", ()), **settings)
    expected = plain_loop(dataset, criteria)
    assert lists(choose(dataset, criteria)) == expected
    assert 0 < sum(map(len, expected.values())) < 2 * sum(COUNTS.values())


def test_workers_choose_the_same(two_kinds):
    dataset, criteria = open_data(two_kinds), with_conditions("returned>0.3", "range_m<4.5", most=5)
    assert lists(choose(dataset, criteria, workers=2)) == lists(choose(dataset, criteria))


def test_a_selection_reads_as_the_samples_that_were_chosen(two_kinds, tmp_path):
    dataset = open_data(two_kinds)
    criteria = with_conditions("occupied>=0.02", "sample<20", worlds=((1, 9),), most=3)
    numbers = choose(dataset, criteria)
    (tmp_path / "s.json").write_bytes(encode_selection(dataset, numbers, criteria, tmp_path))
    selection = open_data(tmp_path / "s.json")
    for split, chosen in numbers.items():
        every, names = samples_of(dataset, split), dataset.split(split).names
        assert samples_of(selection, split) == [every[n] for n in chosen]
        assert selection.split(split).names == [names[n] for n in chosen]


def test_a_selection_of_a_dataset_that_changed_is_refused(written, folder):
    shutil.rmtree(folder / "pillar")
    dataset_in(folder / "pillar", seed=9, counts=COUNTS)
    refuses("changed", open_data, written)


@each_case("dataset/numbers", "numbers")
def test_numbers_that_do_not_rise_within_the_split_are_refused(written, numbers):
    put(written, "datasets.0.samples.train", numbers)
    refuses(numbers, open_data, written)


ENTRIES = "format version chosen_by datasets datasets.0 odd datasets.0.odd datasets.0.path "
ENTRIES += "datasets.0.digest datasets.0.samples datasets.0.samples.train datasets.0.samples.all"


@pytest.mark.parametrize("path", ENTRIES.split())
def test_no_value_in_a_selection_ends_in_a_traceback(written, path):
    good, expected = written.read_bytes(), samples_of(open_data(written), "train")
    for value in NASTY:
        written.write_bytes(good)
        put(written, path, value)
        with contextlib.suppress(DatasetError):
            assert samples_of(open_data(written), "train") in (expected, [])


@pytest.mark.parametrize("content", [b"", b"[]", b"[" * 10**6, b"\xff\xfe", b"{}", b"\0" * 99])
def test_what_is_no_selection_is_refused(tmp_path, content):
    (tmp_path / "s.json").write_bytes(content)
    refuses(ascii(content[:9]), open_data, tmp_path / "s.json")


def test_the_command_writes_what_every_command_reads(two_kinds, tmp_path, capsys):
    done(capsys, f"take {two_kinds} --kind geometric --n 4 --quiet -o {tmp_path}/four.json")
    selection = open_data(tmp_path / "four.json")
    assert [len(selection.split(split)) for split in SPLITS] == [4, 2, 4]


def test_means_over_a_world_are_chosen_by_where_measures_are_kept(two_kinds, measured):
    criteria = with_conditions("world_occupied>=0.02", splits=("train",))
    refuses("not kept", choose, Dataset(two_kinds / "pillar"), criteria)
    dataset, shares = Dataset(measured / "pillar"), {}
    samples = dataset.split("train")
    for sample in samples:
        shares.setdefault(sample.world, []).append(sample.occupancy.mean())
    expected = [n for n, sample in enumerate(samples) if np.mean(shares[sample.world]) >= 0.02]
    assert choose(dataset, criteria)["train"].tolist() == expected


@pytest.fixture
def kept(measured, tmp_path):
    """A dataset with its measures beside it, to change."""
    return Dataset(shutil.copytree(measured / "pillar", tmp_path / "kept"))


DENSE = with_conditions("occupied>=0.02")


def test_damaged_measures_are_measured_again(kept):
    good, expected = measures_file(kept).read_bytes(), lists(choose(kept, DENSE))
    short = encode_measures(np.concatenate(list(kept_measures(kept).values()))[1:])
    edited = [
        good[:place] + bytes([good[place] ^ 1]) + good[place + 1 :]
        for place in (len(good) // 2, len(good) - DIGEST_BYTES - 1, len(good) - 1)
    ]
    for content in (*edited, short, b"", hashlib.sha256().digest()):
        measures_file(kept).write_bytes(content)
        assert kept_measures(kept) == {}
        assert lists(choose(kept, DENSE)) == expected


def test_figures_that_are_signed_and_false_are_refused(kept):
    table = np.concatenate(list(kept_measures(kept).values()))
    table[:, COLUMNS.index("occupied")] += 0.1
    measures_file(kept).write_bytes(encode_measures(table))
    refuses("false", choose, kept, DENSE)


@each_case("dataset/conditions", "text")
def test_a_condition_that_cannot_be_read_is_refused_in_one_line(text):
    refuses(text, Condition.of, text)


@each_case("dataset/signs", "sign held")
def test_a_condition_says_what_its_sign_says(sign, held):
    condition = Condition.of(f" range_m {sign} 1000001.5 ")
    assert Condition.of(str(condition)) == condition
    ends = ".4", ".5", ".6", "nan"
    assert [end for end in ends if condition.holds(1000001 + float(end))] == held.split()
