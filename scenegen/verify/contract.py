"""The manifest, taken at its word only after every value in it has been checked."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pydantic

from lidarsim import GridSpec, Sensor
from scenegen import SPLITS
from scenegen.dataset import manifest, trust
from scenegen.dataset.layout import Layout, layout_of
from scenegen.dataset.sensor import sensor_of
from scenegen.dataset.trust import Entry, Manifest
from scenegen.errors import RecipeError, printable, short
from scenegen.recipe import Recipe, make_recipe
from scenegen.recipes import kind_names
from scenegen.verify.report import BrokenError, Ledger


@dataclass(frozen=True, kw_only=True)
class Contract:
    """What the manifest promises."""

    folder: Path
    kind: str
    seed: int
    fields: tuple[str, ...]
    grid: GridSpec
    lidar: Sensor
    recipe: Recipe
    drawn: bool
    """Whether the recipe can draw the worlds again: they are of a kind known here."""
    viewpoints: int
    """Samples of one flight."""
    scenes: dict[str, list[dict[str, str]]] | None
    """Worlds drawn by hand, by split: {"file", "sha256"}; None where a recipe drew them."""
    generator: int
    """The generator that made it, see `scenegen.GENERATOR`."""
    engine: str
    """Name of the engine that cast its rays. Never imported unless it is one of ours."""
    software: dict[str, str]
    shards: tuple[Entry, ...]
    rejected: Mapping[Any, dict[str, int]]
    digest: str | None
    fingerprint: str
    """What every shard carries, so that it is not taken for another dataset's."""

    @property
    def starts(self) -> tuple[int, ...]:
        """Place of every shard's first sample within its split."""
        total = dict.fromkeys(SPLITS, 0)
        found = []
        for entry in self.shards:
            found.append(total[entry.split])
            total[entry.split] += entry.samples
        return tuple(found)

    @property
    def layout(self) -> Layout:
        """What every shard has to hold."""
        return layout_of(self.fields, self.grid, self.lidar)

    def worlds(self, split: str, start: int, samples: int) -> Sequence[int]:
        """Numbers of the worlds that so many samples of a split are of, from the one at `start` on, rising."""
        units = range(start // self.viewpoints, (start + samples - 1) // self.viewpoints + 1)
        if self.scenes is None:
            return units
        count = len(self.scenes[split])
        return sorted({unit % count for unit in units[:count]})

    def name(self, split: str, place: int) -> tuple[int, int]:
        """(world, viewpoint) of the sample at `place` in its split, as docs/format.md numbers them."""
        unit, view = divmod(place, self.viewpoints)
        if self.scenes is None:
            return unit, view
        turn, world = divmod(unit, len(self.scenes[split]))
        return world, turn * self.viewpoints + view


def read_contract(folder: Path, ledger: Ledger) -> Contract | None:
    """The contract of the dataset in `folder`; faults go to the ledger's `manifest`, None where it cannot be read on.

    Raises DatasetError where the folder holds no dataset at all.
    """
    given = manifest.read(folder)
    contract = None
    with ledger.checking("manifest"):
        ledger.count("manifest", files=1)
        found = _contract(folder, given)
        _check_shards(found, given, ledger)
        contract = found
    return contract


def _contract(folder: Path, given: dict[str, Any]) -> Contract:
    """The manifest with every type checked. Raises BrokenError."""
    try:
        typed = trust.typed(given)
    except BrokenError as error:
        raise BrokenError(f"{manifest.NAME}: {error}") from None
    drawn = typed.kind in kind_names()
    recipe = _recipe(typed, given["recipe"], drawn, sensor_of(typed.lidar, folder))
    scenes = None
    if typed.kind == "scene":
        scenes = _scenes(given["recipe"])
    return Contract(
        folder=folder,
        kind=typed.kind,
        seed=typed.seed,
        fields=tuple(typed.fields),
        grid=recipe.grid,
        lidar=recipe.lidar,
        recipe=recipe,
        drawn=drawn,
        viewpoints=recipe.flight.viewpoints,
        scenes=scenes,
        generator=typed.generator,
        engine=typed.engine,
        software=typed.software,
        shards=tuple(typed.shards),
        rejected=typed.rejected,
        digest=typed.digest,
        fingerprint=manifest.fingerprint_of(given),
    )


def _recipe(typed: Manifest, given: dict[str, Any], drawn: bool, sensor: Sensor) -> Recipe:
    """The recipe that the manifest spells out; that of an unknown kind is taken without its world."""
    tables = {name: table for name, table in given.items() if name not in ("version", "scenes")}
    tables |= {
        "grid": {
            "shape": tuple(typed.grid.shape),
            "voxel_m": typed.grid.voxel,
            "truncation_m": typed.grid.truncation,
        },
    }
    if not drawn:
        tables.pop("world", None)
    try:
        return make_recipe(typed.kind if drawn else "scene", tables, where=manifest.NAME, sensor=sensor)
    except RecipeError as error:
        raise BrokenError(str(error)) from None


def _scenes(recipe: dict[str, Any]) -> dict[str, list[dict[str, str]]]:
    found = recipe.get("scenes")
    kind = pydantic.TypeAdapter(dict[Literal["train", "val", "test"], list[dict[str, str]]])
    try:
        return {str(split): worlds for split, worlds in kind.validate_python(found, strict=True).items()}
    except pydantic.ValidationError:
        raise BrokenError(
            f"{manifest.NAME}: recipe.scenes = {short(found)}: expected the worlds of each split"
        ) from None


def _check_shards(contract: Contract, given: dict[str, Any], ledger: Ledger) -> None:
    """Whether the shards listed are those that the counts ask for, in order, and no other lies in the folder."""
    where = manifest.NAME
    ledger.expect("manifest", given["complete"], f"{where}: complete is false: give the command that made it again")
    ledger.expect(
        "manifest",
        (contract.digest is not None) == given["complete"],
        f"{where}: digest = {contract.digest}: expected one exactly where complete is true",
    )
    order = [SPLITS.index(entry.split) for entry in contract.shards]
    ledger.expect("manifest", order == sorted(order), f"{where}: shards are not in the order train, val, test")
    for split in SPLITS:
        entries = [entry for entry in contract.shards if entry.split == split]
        total = sum(entry.samples for entry in entries)
        asked = given["counts"].get(split, 0)
        whole = given["complete"]
        ledger.expect(
            "manifest",
            total == asked if whole else total <= asked,
            f"{where}: counts.{split} = {asked}, but its shards hold {total} samples",
        )
        if contract.scenes is not None and entries and not contract.scenes.get(split):
            raise BrokenError(f"{where}: recipe.scenes names no world for {split}, which has samples")
        for number, entry in enumerate(entries):
            _check_name(entry, number if whole else None, ledger)
            full = number == len(entries) - 1 or entry.samples % contract.viewpoints == 0
            ledger.expect("manifest", full, f"{where}: {entry.file} holds {entry.samples} samples: a flight is cut")
    listed = {name for entry in contract.shards for name in (entry.file, entry.worlds)}
    files = {path.name for path in contract.folder.iterdir() if path.suffix in (".h5", ".zip")}
    others = printable(", ".join(sorted(files - listed)[:3]))
    ledger.expect(
        "manifest",
        not others,
        f"{others}: in the folder, but {where} does not list it",
    )


def _check_name(entry: Entry, number: int | None, ledger: Ledger) -> None:
    """File names are plain, and number the shards. Raises BrokenError for one that leaves the folder."""
    match = re.fullmatch(rf"{entry.split}-(\d{{5}})", entry.file.removesuffix(".h5"))
    if not match or entry.file != f"{match[0]}.h5" or entry.worlds != f"{match[0]}.worlds.zip":
        raise BrokenError(
            f"{manifest.NAME}: shard files {short(entry.file)}, {short(entry.worlds)}: expected "
            f"{entry.split}-00000.h5, {entry.split}-00000.worlds.zip and so on"
        )
    if number is not None:
        ledger.expect(
            "manifest",
            int(match[1]) == number,
            f"{manifest.NAME}: {entry.file} stands where {entry.split}-{number:05d}.h5 is expected",
        )
