"""Checks of viewpoints: all differ, those of a flight have the recipe's distance, and the recipe
accepts each."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenegen import SPLITS
from scenegen.dataset.manifest import Manifest
from scenegen.verification.check import Check, RawSample
from scenegen.verification.report import Page

CONTENT = np.dtype([("content", "S16"), ("row", "<u4")])
"""Kept of each sample to find duplicates: half of a SHA-256."""
PLACE = np.dtype([("place", "<i8"), ("position", "<f8", 3)])
"""Kept of each sample to measure distances on its flight: its position in the split, and in the
world."""
ROUNDING_M = 1e-9
"""Tolerance of distances, metres."""
ROUNDING_S = 1e-9
"""Tolerance of times, seconds."""


def _keep(sample: RawSample, page: Page, record: NDArray[Any]) -> None:
    """Keep a record for the examination of the whole dataset."""
    if not page.kept:  # once a shard: there may be millions of samples
        page.kept.append((sample.shard.task.number, bytearray()))
    page.kept[0][1].extend(record.tobytes())


def _all_kept(page: Page, kind: np.dtype) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """All kept records (N,), and the number of the shard of each, (N,)."""
    records = [np.frombuffer(content, kind) for _, content in page.kept]
    numbers = np.array([number for number, _ in page.kept], np.int64)
    counts = [len(shard_records) for shard_records in records]
    return np.concatenate([np.empty(0, kind), *records]), np.repeat(numbers, counts)


def _keep_content(sample: RawSample, page: Page) -> None:
    page.count(samples=1)
    _keep(sample, page, np.array((sample.content.digest()[:16], sample.row), CONTENT))


def _differ(contract: Manifest, page: Page) -> None:
    records, shards = _all_kept(page, CONTENT)
    # stable: equal records stay in the order of shards
    order = np.argsort(records["content"], kind="stable")
    contents = records["content"][order]
    for n in np.flatnonzero(contents[1:] == contents[:-1]):
        first, second = (
            f"{contract.shards[shards[at]].file}: sample {records['row'][at]}"
            for at in order[n : n + 2]
        )
        page.fault(f"{second} has the content of {first}, expected that of another viewpoint")


def _flown(sample: RawSample, page: Page) -> None:
    page.count(samples=1)
    contract, position = sample.contract, sample.fields["position"]
    _keep(sample, page, np.array((sample.shard.first_place + sample.row, position), PLACE))
    recipe, spacing_m = contract.recipe, contract.mapping.scan_spacing_m
    # the recipe has no bounds of worlds from files
    if recipe.world is not None:
        low, high = recipe.flight.bounds(recipe.world.size_m)
        page.expect(
            (position >= low - ROUNDING_M).all() and (position <= high + ROUNDING_M).all(),
            f"{sample.where}: its position {position.tolist()} is not within "
            f"{low.tolist()} and {high.tolist()}, where the recipe's flights keep",
        )
    earlier = sample.fields.get("earlier_position", np.empty((0, 3)))
    positions = np.concatenate([position[None], earlier])
    steps_m = _distances_m(positions[:-1], positions[1:])
    page.expect(
        (steps_m <= spacing_m + ROUNDING_M).all(),
        f"{sample.where}: from scan to scan are {steps_m.max(initial=0):.6g} m, expected at most "
        f"mapping.scan_spacing_m = {spacing_m:g}",
    )
    # a dataset like another one keeps times that its own recipe need not give
    if recipe.traffic is None or contract.like is not None:
        return
    times_s, end_s = (sample.fields[name] for name in ("scan_times", "course_end"))
    before_s = spacing_m / recipe.traffic.sensor_mps * np.arange(len(times_s))
    wrong_s = np.abs(np.maximum(times_s[0] - before_s, 0.0) - times_s)
    page.expect(
        # NaN fails, too
        bool((wrong_s <= ROUNDING_S).all())
        and abs(times_s[0] + recipe.traffic.after_s - end_s) <= ROUNDING_S,
        f"{sample.where}: scan_times {times_s.tolist()} and course_end {end_s:g} are not what "
        f"movers.sensor_mps = {recipe.traffic.sensor_mps:g}, movers.after_s = "
        f"{recipe.traffic.after_s:g} and mapping.scan_spacing_m = {spacing_m:g} give",
    )


def _far_apart(contract: Manifest, page: Page) -> None:
    records, shards = _all_kept(page, PLACE)
    flight = contract.recipe.flight
    splits = np.array([SPLITS.index(entry.split) for entry in contract.shards], np.int64)[shards]
    units, spacing_m = records["place"] // flight.viewpoints, flight.spacing_m
    # by split, then by position in it
    order = np.lexsort((records["place"], splits))
    # samples of one flight are neighbours in this order: compare with the next one, the next but
    # one, and so on, until no two are of the same flight
    for step in range(1, len(order)):
        first, second = order[:-step], order[step:]
        pairs = (units[first] == units[second]) & (splits[first] == splits[second])
        if not pairs.any():
            break
        first, second = first[pairs], second[pairs]
        apart_m = _distances_m(records["position"][first], records["position"][second])
        # negated, so that NaN counts as too close
        for n in np.flatnonzero(~(apart_m >= spacing_m - ROUNDING_M)):
            named = (f"{contract.shards[shards[at]].file}" for at in (first[n], second[n]))
            page.fault(
                f"{' and '.join(dict.fromkeys(named))}: samples {records['place'][first[n]]} and "
                f"{records['place'][second[n]]} of {SPLITS[splits[first[n]]]} are of one flight "
                f"and {apart_m[n]:.6g} m apart, expected flight.spacing_m = {spacing_m:g}"
            )


def _distances_m(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances (N,) of points (N, 3), metres; NaN or infinite if a coordinate is."""
    with np.errstate(invalid="ignore", over="ignore"):
        distances_m: NDArray[np.float64] = np.sqrt(((first - second) ** 2).sum(axis=1))
    return distances_m


def _accepted(sample: RawSample, page: Page) -> None:
    page.count(samples=1)
    contract, fields = sample.contract, sample.fields
    if contract.like is not None:
        return  # a dataset like another one keeps every viewpoint, whatever its sensor sees
    accept, known = contract.recipe.accept, contract.known
    occupied = int(np.bitwise_count(sample.packed["occupancy"]).sum()) / fields["occupancy"].size
    shares = {"accept.min_occupied_share": (occupied, accept.min_occupied_share)}
    if contract.noise is None:  # noise may remove returns after a viewpoint was accepted
        returned = np.isfinite(fields["ranges"]).mean()
        shares["accept.min_returned_share"] = (returned, accept.min_returned_share)
    if known is not None:
        shares["known.least_share"] = (fields["known"].mean(), known.least_share)
        marked = (~fields["ray_known"]).mean()
        shares["1 - known.most_marked_share"] = (1 - marked, 1 - known.most_marked_share)
    for name, (share, minimum) in shares.items():
        page.expect(
            share >= minimum,
            f"{sample.where}: a share of {share:.4g} is too small to be kept with {name} = "
            f"{minimum:g}",
        )


CHECKS = (
    Check(name="duplicates", quick=True, sample=_keep_content, folder=_differ),
    Check(name="flights", quick=True, sample=_flown, folder=_far_apart),
    Check(name="accepted", quick=True, sample=_accepted),
)
