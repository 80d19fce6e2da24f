"""Checks of stored fields: laws that they satisfy, and derived fields computed again and compared
bit for bit."""

import hashlib
import math
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim.engines import DEFAULT
from lidarsim.engines.voxels import VoxelMap
from lidarsim.movers import Movers
from scenegen.base.errors import CorruptFileError, DatasetError, GenerationError, reraise_as
from scenegen.base.reading import sha256_of
from scenegen.dataset.manifest import Manifest
from scenegen.dataset.schema import NAME
from scenegen.draw.movers import mover_voxels, stored_movers
from scenegen.draw.parts import PARTS
from scenegen.truth import distance_field, rasterize
from scenegen.truth.voxels import resample
from scenegen.verification.check import Check, RawSample, times_of
from scenegen.verification.rays import count_strays
from scenegen.verification.report import Page
from scenegen.worlds.place import Place

EARLIER = ("earlier_ranges", "earlier_position", "earlier_quaternion")
"""Fields that extend the digest of a sample with several scans."""
LABELLED = ("return_geom", "return_class", "voxel_geom", "voxel_class")
"""Fields that extend the digest of a labelled sample."""
NORMALS = ("return_normal",)
"""Fields that extend the digest of a sample with normals."""
KNOWN = ("known", "ray_known")
"""Fields that extend the digest of a sample in a map of a real place."""
MOVERS = (
    *("scan_times", "course_end", "static_occupancy", "voxel_mover", "return_mover"),
    *("mover_kind", "mover_solids", "mover_course"),
)
"""Fields that extend the digest of a sample with movers."""
LEAN = 1e-9
"""Tolerance of the cosine of a body's tilt."""


def _own_digest(sample: RawSample, page: Page) -> None:
    page.count(samples=1)
    # not by `Sample.sha256`, which made it: two programs must agree on docs/format.md
    content_hash = sample.content.copy()
    for name in ("world", "viewpoint"):
        content_hash.update(sample.fields[name].tobytes())
    digest = content_hash.digest()
    # each group extends the digest of the groups before it
    for names in (EARLIER, LABELLED, NORMALS, KNOWN, MOVERS):
        if names[0] in sample.fields:
            digest = hashlib.sha256(
                digest + b"".join(sample.fields[name].tobytes() for name in names)
            ).digest()
    if not page.kept:  # once a shard: there may be millions of samples
        page.kept.append(bytearray())
    page.kept[0].extend(digest)
    page.expect(
        digest == sample.own_digest,
        f"{sample.where}: its content does not have the digest stored beside it",
    )


def _whole_digest(contract: Manifest, page: Page) -> None:
    digest = sha256_of(b"".join(page.kept))
    page.expect(
        contract.digest in (None, digest),
        f"{NAME}: digest {str(contract.digest)[:16]}…, the samples' is {digest[:16]}…",
    )


def _numbered(sample: RawSample, page: Page) -> None:
    page.count(samples=1)
    entry, name = sample.shard.task.entry, (sample.world, int(sample.fields["viewpoint"]))
    place = sample.shard.first_place + sample.row
    expected = sample.contract.numbering(entry.split).name(place)
    page.expect(
        name == expected,
        f"{sample.where}: is world {name[0]}, viewpoint {name[1]}, expected {expected}",
    )


def _centred(sample: RawSample, page: Page) -> None:
    page.count(samples=1)
    mapping, grid, fields = sample.contract.mapping, sample.contract.grid, sample.fields
    attitudes = np.concatenate(
        [fields["quaternion"][None], fields.get("earlier_quaternion", np.empty((0, 4)))]
    )
    for length in np.sqrt((attitudes**2).sum(axis=1)).tolist():
        page.expect(
            abs(length - 1) <= 1e-9, f"{sample.where}: quaternion has length {length:g}, expected 1"
        )
    # a dataset like another one keeps poses that its own mapping need not allow
    if mapping.tilt_mps or sample.contract.like is None:
        max_deg = mapping.most_tilt_deg if mapping.tilt_mps else 0.0
        # cosine of the tilt: z component of the body's z axis in the world
        upright = 1 - 2 * (attitudes[:, 1] ** 2 + attitudes[:, 2] ** 2)
        limit = f"mapping.most_tilt_deg = {max_deg:g}" if max_deg else "0 degrees, without a tilt"
        is_upright = bool((upright >= math.cos(math.radians(max_deg)) - LEAN).all())
        page.expect(is_upright, f"{sample.where}: a body leans by more than {limit}")
    with reraise_as(CorruptFileError, f"{sample.where}: "):
        # a centred map depends on the position only, which is valid even if the attitude is not
        expected = (
            grid.origin_at(fields["position"])
            if mapping.centred
            else mapping.origin(grid, sample.scans[0].pose)
        )
    offset_m = float(np.abs(fields["origin"] - expected).max())
    reference = "position" if mapping.centred else "position, moved by mapping.map_ahead_m,"
    page.expect(
        # no tolerance: `origin` follows from the pose bit for bit
        offset_m == 0.0,
        f"{sample.where}: origin is {offset_m:.3g} m from {reference} less half the grid",
    )


def _lawful(sample: RawSample, page: Page) -> None:
    page.count(samples=1)
    max_range_m, invalid = sample.contract.lidar.max_range_m, 0
    for name in ("ranges", "earlier_ranges"):
        ranges = sample.fields.get(name, np.empty(0, np.float32))
        # negated, so that NaN counts as invalid
        invalid += int((~(ranges >= 0) | ((ranges > max_range_m) & np.isfinite(ranges))).sum())
    page.expect(
        not invalid, f"{sample.where}: {invalid} ranges are not from 0 to {max_range_m:g} m, or inf"
    )
    if "known" in sample.fields:
        unknown = np.count_nonzero(sample.fields["occupancy"] & ~sample.fields["known"])
        page.expect(not unknown, f"{sample.where}: {unknown} voxels are occupied and not known")
    noise = sample.contract.noise
    if noise is None:
        # without noise, every return lies on a solid
        stray = int(np.bitwise_count(sample.packed["observed"] & ~sample.packed["occupancy"]).sum())
        if "movers" in sample.contract.parts:
            stray = _strays_in_time(sample, None)
        page.expect(not stray, f"{sample.where}: {stray} observed voxels are not occupied")
    # unbounded noise may put returns anywhere
    elif noise.bound_m is not None:
        fields, grid, bound = sample.fields, sample.contract.grid, noise.bound_m
        if "movers" in sample.contract.parts:
            stray = _strays_in_time(sample, bound)
        else:
            points = np.concatenate([scan.points() for scan in sample.scans])
            stray = count_strays(points, fields["occupancy"], grid, fields["origin"], bound)
        page.expect(
            not stray,
            f"{sample.where}: {stray} returns lie more than {bound:g} m from what is occupied",
        )
    if "free" in sample.fields:
        contradictions = np.count_nonzero(sample.fields["free"] & sample.fields["observed"])
        page.expect(
            not contradictions,
            f"{sample.where}: {contradictions} voxels are both free and observed",
        )


def _movers_of(sample: RawSample) -> Movers:
    """Movers of a sample's tables. Raises CorruptFileError if they are damaged."""
    with reraise_as(CorruptFileError, f"{sample.where}: ", of=DatasetError):
        return stored_movers(SimpleNamespace(**sample.fields))


def _strays_in_time(sample: RawSample, bound_m: float | None) -> int:
    """Count returns of each scan where nothing was when that scan began: voxels of clean returns,
    or returns that are farther than `bound_m` from what was occupied.

    If rays have times of their own, returns near movers are not judged here."""
    contract, fields, stray = sample.contract, sample.fields, 0
    recipe, grid, origin = contract.recipe, contract.grid, fields["origin"]
    movers = _movers_of(sample)
    for scan, time_s in zip(sample.scans, sample.times_s.tolist(), strict=True):
        points = scan.points()
        if recipe.scan_s:
            away = movers.distances_m(points, time_s, recipe.scan_s)
            points = points[away > (bound_m or 0.0)]
        there = fields["static_occupancy"] | (mover_voxels(movers, grid, origin, time_s) >= 0)
        if bound_m is not None:
            stray += count_strays(points, there, grid, origin, bound_m)
            continue
        index = grid.index(points, origin)
        index = index[((index >= 0) & (index < grid.shape)).all(axis=1)]
        seen = np.zeros(grid.shape, bool)
        seen[tuple(index.T)] = True
        stray += int(np.count_nonzero(seen & ~there))
    return stray


def _part_laws(sample: RawSample, page: Page) -> None:
    contract = sample.contract
    # other engines may differ where rays graze an edge
    exact = contract.noise is None and contract.engine == DEFAULT
    for name, settings in contract.parts.items():
        page.count(samples=1)
        for line in PARTS[name].broken_laws(sample.fields, settings, exact=exact):
            page.fault(f"{sample.where}: {line}")


def _expect_equal(
    sample: RawSample, name: str, expected: NDArray[Any], source: str, page: Page
) -> None:
    """Compare a stored field bit for bit with one that was computed again from `source`."""
    # compared by bits, so that NaN equals itself and -0.0 differs from 0.0
    stored, bits = sample.fields[name], f"u{expected.itemsize}"
    if np.array_equal(stored.view(bits), expected.view(bits)):
        return
    differing = np.argwhere(stored.view(bits) != expected.view(bits))
    first = tuple(int(n) for n in differing[0]) if len(differing) else ()
    example = f", at {first} {stored[first]} is stored, {expected[first]} expected" if first else ""
    page.fault(
        f"{sample.where}: {name} is not what follows from {source}: {len(differing)} values "
        f"differ{example}"
    )


def _tudf(sample: RawSample, page: Page) -> None:
    page.count(samples=1)
    again = distance_field(sample.fields["occupancy"], sample.contract.grid)
    _expect_equal(sample, "tudf", again, "occupancy", page)


def _seen(name: str, sample: RawSample, page: Page) -> None:
    page.count(samples=1)
    _expect_equal(sample, name, getattr(sample.seen, name), "ranges", page)


def _occupancy(sample: RawSample, page: Page) -> None:
    if sample.solids is None:
        return
    page.count(samples=1)
    solids, grid, origin = sample.solids, sample.contract.grid, sample.fields["origin"]
    # a world of solids is known everywhere
    known = np.ones(grid.shape, bool)
    if isinstance(solids, VoxelMap):
        again, known = resample(solids, grid, origin)
    else:
        again = rasterize(solids, grid, origin)
    if "movers" in sample.contract.parts:
        _expect_equal(sample, "static_occupancy", again, f"world {sample.world}", page)
        # movers, from the sample's own tables, are what is occupied beside
        movers = _movers_of(sample)
        again = again | rasterize(movers.solids(float(sample.times_s[0])), grid, origin)
        mover = mover_voxels(movers, grid, origin, float(sample.times_s[0]))
        _expect_equal(sample, "voxel_mover", mover, "its movers", page)
    _expect_equal(sample, "occupancy", again, f"world {sample.world}", page)
    if "known" in sample.fields:
        _expect_equal(sample, "known", known, f"world {sample.world}", page)


def _rays_known(sample: RawSample, page: Page) -> None:
    world, known = sample.audited, sample.contract.known
    if world is None or known is None:
        return
    page.count(samples=1)
    again = world.unknown_m(sample.scans[0]) <= known.most_unknown_m
    _expect_equal(sample, "ray_known", again, f"world {sample.world}", page)


def _parts_again(sample: RawSample, page: Page) -> None:
    contract = sample.contract
    if not contract.parts or (world := sample.audited) is None:
        return
    page.count(samples=1)
    if isinstance(world, Place):
        raise CorruptFileError(
            f"{sample.where}: has {' and '.join(contract.parts)}, and its world is a map, which "
            f"has none"
        )
    times_of(contract, sample.fields.__getitem__)  # refuses times that nothing can be computed at
    for name, settings in contract.parts.items():
        with reraise_as(CorruptFileError, f"{sample.where}: ", of=GenerationError):
            again = PARTS[name].compute(sample.fields, world, contract.recipe, settings)
        for field, values in again.items():
            _expect_equal(sample, field, values, f"world {sample.world}", page)


CHECKS = (
    Check(name="digest", quick=True, sample=_own_digest, folder=_whole_digest),
    Check(name="names", quick=True, sample=_numbered),
    Check(name="centred", quick=True, sample=_centred),
    Check(name="laws", quick=True, sample=_lawful),
    Check(name="part-laws", quick=True, part=True, sample=_part_laws),
    Check(name="tudf", field="tudf", sample=_tudf),
    Check(name="voxels", sample=partial(_seen, "observed")),
    Check(name="free", field="free", sample=partial(_seen, "free")),
    Check(name="parts", part=True, sample=_parts_again),
    Check(name="occupancy", sample=_occupancy),
    Check(name="known", field="ray_known", sample=_rays_known),
)
