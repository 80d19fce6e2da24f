"""Which part an index takes, and which samples a batch: laws of numbers, for which nothing is
drawn."""

import json
from collections import Counter
from fractions import Fraction

import numpy as np
import pytest

import scenegen
from scenegen.draw.source import DrawnWorlds
from scenegen.streams.mixture import Component, Mixture
from scenegen.streams.stream import Stream
from tests.conftest import small_recipe
from tests.refusals import refuses
from tests.scenegen import each_case
from tests.scenegen.conftest import same

VIEWPOINTS = (1, 2, 3, 5, 6)
COMPONENTS = {
    count: Component(label=str(count), recipe=recipe, source=DrawnWorlds(recipe))
    for count in VIEWPOINTS
    for recipe in [small_recipe(flight={"viewpoints": count})]
}


def drawn(seed, most, parts):
    """Weights up to `most` of up to so many parts, and what drew them."""
    rng = np.random.default_rng(seed)
    chosen = rng.permutation(VIEWPOINTS)[: rng.integers(1, parts + 1)].tolist()
    return {count: int(rng.integers(1, most + 1)) for count in chosen}, rng


def mixed(weights, samples=10**6):
    mixture = Mixture([COMPONENTS[count] for count in weights], list(weights.values()))
    return Stream(mixture, seed=0, split="train", samples=samples, workers=0)


@pytest.mark.parametrize("seed", range(15))
def test_parts_come_in_order_whole_and_in_proportion(seed):
    weights, _ = drawn(seed, 9, 3)
    stream, counts = mixed(weights), list(weights)
    # the rule, by counting: the flight whose place is the least comes next, and is not torn apart;
    # each part by itself is a dataset from its beginning on
    flown, expected = Counter(), []
    units = [Fraction(weight, count) for count, weight in weights.items()]
    while len(expected) < 400:
        rounds = [Fraction(2 * flown[k] + 1, 2) / units[k] for k in range(len(units))]
        part = rounds.index(min(rounds))
        expected += [(part, flown[part] * counts[part] + n) for n in range(counts[part])]
        flown[part] += 1
    assert [stream.part(index) for index in range(len(expected))] == expected


def test_decimal_weights_are_meant_as_they_are_written():
    decimal, whole = mixed({1: 0.7, 2: 0.3}), mixed({1: 7, 2: 3})
    assert decimal.digest == whole.digest
    assert [decimal.part(n) for n in range(99)] == [whole.part(n) for n in range(99)]


def test_a_mixtures_part_is_that_parts_own_stream():
    recipes = [small_recipe("pillar"), small_recipe("geometric")]
    mixture = scenegen.stream([(recipes[0], 2), recipes[1]])
    alone = [scenegen.stream(recipe) for recipe in recipes]
    for index in (0, 4, 5, 8, 11):
        part, number = mixture.part(index)
        assert same(mixture[index], alone[part][number])


@pytest.mark.parametrize("seed", range(15))
def test_batches_hold_each_sample_once_and_share_no_flight(seed):
    weights, rng = drawn(seed, 3, 2)
    each, ranks, loaders = rng.integers(1, (5, 4, 4)).tolist()
    size = each * ranks
    stream = mixed(weights)
    row = stream.mixture.row
    stream = mixed(weights, samples=row * size * loaders * 3)
    batches = stream.batches(size, loaders=loaders)
    everything = list(batches)
    assert len(everything) == len(batches)
    assert sorted(index for batch in everything for index in batch) == list(range(len(stream)))
    for batch in everything:
        assert len(batch) == size
        assert len({index // row for index in batch}) == size
    readers = {}
    for rank in range(ranks):
        theirs = stream.batches(size, rank=rank, ranks=ranks, loaders=loaders)
        for number, (batch, share) in enumerate(zip(everything, theirs, strict=True)):
            assert share == batch[rank::ranks]
            for index in share:
                readers.setdefault(index // row, set()).add((rank, number % loaders))
    assert all(len(each) == 1 for each in readers.values())


def test_batches_go_on_where_a_state_says_with_any_ranks():
    stream = mixed({3: 1, 6: 2}, samples=600)

    def batches(size=4, of=stream, loaders=2, **more):
        return of.batches(size, loaders=loaders, **more)

    begun, everything = batches(), list(batches())
    first = [next(begun) for _ in range(7)]
    state = json.dumps(begun.state_dict())
    assert len(state) < 120
    resumed, half = batches(), batches(rank=1, ranks=2)
    for batches_after in (resumed, half):
        batches_after.load_state_dict(json.loads(state))
    assert first + list(resumed) == everything
    assert list(resumed) == everything  # a pass that ended begins anew
    assert next(half) == everything[7][1::2]
    others = {"size": {"size": 8}, "loaders": {"loaders": 1}, "stream": {"of": mixed({3: 1, 6: 1})}}
    for case, options in others.items():
        refuses(case, batches(**options).load_state_dict, json.loads(state))


@each_case("streams/order", "options")
def test_batches_that_cannot_be_end_in_a_line(options):
    refuses(options, mixed({3: 1}, samples=50).batches, **json.loads(options))
