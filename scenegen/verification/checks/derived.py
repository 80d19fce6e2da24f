"""Checks that compute grids and distances anew from what they follow from, and compare them bit for
bit."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenegen.sample import LABELS, SCHEMA, derive_tudf
from scenegen.sample import Sample as Plain
from scenegen.truth import rasterize
from scenegen.verification.check import Check
from scenegen.verification.report import Page
from scenegen.verification.stages import Sample
from scenegen.worlds.labels import labelled


def _same(sample: Sample, name: str, again: NDArray[Any], source: str, page: Page) -> None:
    """Hold a stored field against what follows `again` from its `source`."""
    stored, bits = sample.fields[name], f"u{again.itemsize}"
    if np.array_equal(stored.view(bits), again.view(bits)):
        return
    differing = np.argwhere(stored.view(bits) != again.view(bits))
    first = tuple(int(n) for n in differing[0]) if len(differing) else ()
    here = f", at {first} {stored[first]} is stored, {again[first]} expected" if first else ""
    page.fault(
        f"{sample.where}: {name} is not what follows from {source}: {len(differing)} voxels "
        f"differ{here}"
    )


def _tudf(sample: Sample, page: Page) -> None:
    page.count(samples=1)
    again = derive_tudf(sample.fields["occupancy"], grid=sample.contract.grid)
    _same(sample, "tudf", again, "occupancy", page)


def _observed(sample: Sample, page: Page) -> None:
    page.count(samples=1)
    _same(sample, "observed", sample.seen.observed, "ranges", page)


def _free(sample: Sample, page: Page) -> None:
    page.count(samples=1)
    _same(sample, "free", sample.seen.free, "ranges", page)


def _occupancy(sample: Sample, page: Page) -> None:
    if sample.solids is None:
        return
    page.count(samples=1)
    again = rasterize(sample.solids, sample.contract.grid, sample.fields["origin"])
    _same(sample, "occupancy", again, f"world {sample.world}", page)


def _owners(sample: Sample, page: Page) -> None:
    if (
        sample.solids is None
        or sample.shard.worlds is None
        or sample.row not in sample.shard.audited
    ):
        return
    page.count(samples=1)
    world = sample.shard.worlds.world(sample.world)
    contract = sample.contract
    plain: dict[str, Any] = {
        name: sample.fields.get(name, np.empty(0)) for name in SCHEMA
    }  # of its own scan
    again = labelled(Plain(**plain), world, contract.lidar, contract.grid, contract.recipe.labels)
    for name in LABELS:
        _same(sample, name, getattr(again, name), f"world {sample.world}", page)


CHECKS = (
    Check(
        name="tudf",
        proves="Distances follow from `occupancy`, bit for bit.",
        field="tudf",
        sample=_tudf,
    ),
    Check(
        name="voxels",
        proves="`observed` follows from the ranges and poses of all scans and the origin, bit for "
        "bit.",
        sample=_observed,
    ),
    Check(
        name="free",
        proves="`free` follows from the ranges and poses of all scans and the origin, bit for bit.",
        field="free",
        sample=_free,
    ),
    Check(
        name="owners",
        proves="Geoms and classes of 5 % of the samples with labels (of 8 a shard at least) "
        "follow from the "
        "archived world.",
        field="voxel_geom",
        sample=_owners,
    ),
    Check(
        name="occupancy",
        proves="`occupancy` follows from the archived world, bit for bit.",
        sample=_occupancy,
    ),
)
