"""What a stream draws from, and units made before they are asked for.

A mixture has components, each a recipe and where its worlds come from, and says which of them takes
an index. Worker processes make the units ahead, and pack them small.
"""

import contextlib
import json
import math
import multiprocessing.connection
import os
import weakref
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import isal.isal_zlib
import msgspec
import numpy as np

from scenegen import GENERATOR, SPLITS
from scenegen.base.errors import DatasetError, GenerationError, RecipeError, SceneError, short
from scenegen.base.files import Json, sha256_of
from scenegen.base.limits import MOST_UNITS_IN_ROUND
from scenegen.base.paths import WORLD_FILES
from scenegen.base.workers import MOST_REPLACED, Worker
from scenegen.dataset.build import recipe_entry
from scenegen.dataset.shard import Units, find_engine
from scenegen.draw.mixture import fraction
from scenegen.draw.sample import FIELDS, Sample, Schema
from scenegen.draw.source import DrawnWorlds, SceneWorlds, read_scenes, world_files
from scenegen.truth import distance_field
from scenegen.worlds.kinds import KINDS, graded
from scenegen.worlds.recipe import Recipe, preset, read_recipe

Unit = tuple[bytes, ...]
"""The records of a unit's samples."""
Slot = tuple[int, int]
"""Which unit: the number of its component in a mixture, and its own there."""
LEVEL = 1
"""The level of compression, as in shards."""


def record_type(schema: Schema) -> np.dtype:
    """The record of one sample: flags as bits, everything else as it is stored on disk. Distances
    follow from occupancy, and are ten times as large as all the rest: they are not in it."""
    columns: list[tuple[Any, ...]] = []
    for name in schema.names:
        if name == "tudf":
            continue
        shape = schema.shape(name)
        if _is_flags(name):
            columns.append((name, "u1", -(-math.prod(shape) // 8)))
        else:
            columns.append((name, FIELDS[name]["dtype"], shape))
    return np.dtype(columns)


def _is_flags(name: str) -> bool:
    """Whether a field's values are true or false, which a record holds as bits."""
    return bool(FIELDS[name]["dtype"] == "bool")


def pack(sample: Sample, kind: np.dtype) -> bytes:
    """A sample's record, compressed."""
    record = np.zeros((), kind)
    for name in kind.names or ():
        value = getattr(sample, name)
        record[name] = np.packbits(value) if _is_flags(name) else value
    return isal.isal_zlib.compress(record.tobytes(), LEVEL)


def unpack(packed: bytes, kind: np.dtype, schema: Schema) -> Sample:
    """The sample of a record; arrays of its own, which may be written to."""
    record = np.frombuffer(isal.isal_zlib.decompress(packed), kind)[0]

    def find(sample: Sample, name: str) -> Any:
        if name == "tudf":
            return distance_field(sample.occupancy, schema.grid)
        value: np.ndarray = record[name]
        if _is_flags(name):
            shape = schema.shape(name)
            return np.unpackbits(value, count=math.prod(shape)).view(bool).reshape(shape)
        return value.item() if FIELDS[name]["axes"] == "" else value.copy()

    return Sample.lazy(schema.names, find, lidar=schema.lidar, grid=schema.grid)


class Ahead:
    """`workers` processes that make units in the order in which they are given. They end with this
    object, and with this process whatever ends it; one that dies is replaced, and its units are
    given again."""

    def __init__(self, make: Callable[[Slot], Unit], workers: int):
        self._make, self._died = make, 0
        self._given = {Worker(make): deque[Slot]() for _ in range(workers)}
        self._done: dict[Slot, tuple[bool, Any]] = {}
        # unlike a `__del__`, it runs at exit before the modules that it needs are gone
        self.close = weakref.finalize(self, _end, self._given, os.getpid())
        """End the processes, whatever they are doing."""

    @property
    def under_way(self) -> int:
        """Units that were given, and that nobody took."""
        return len(self._done) + sum(map(len, self._given.values()))

    def __contains__(self, slot: object) -> bool:
        return slot in self._done or any(slot in given for given in self._given.values())

    def give(self, slot: Slot) -> None:
        """Have a unit made; one that is under way is not given again."""
        if slot not in self:
            worker, given = min(self._given.items(), key=lambda one: len(one[1]))
            given.append(slot)
            with contextlib.suppress(OSError):  # it died, which `collect` notices
                worker.pipe.send(slot)

    def take(self, slot: Slot) -> Unit:
        """A unit, as soon as it is there. Raises what making it raises, and GenerationError where
        processes die again and again."""
        self.give(slot)
        self.collect()
        while slot not in self._done:
            self.collect(wait=True)
        succeeded, value = self._done.pop(slot)
        if not succeeded:
            raise value
        return value

    def collect(self, *, wait: bool = False) -> None:
        """Take in what is finished, or, with `wait`, at least one thing."""
        workers = {worker.pipe: worker for worker in self._given}
        for pipe in multiprocessing.connection.wait(workers, None if wait else 0):
            worker = workers[pipe]
            try:
                answer = worker.pipe.recv()
            except (EOFError, OSError):
                self._replace(worker)
                continue
            self._done[self._given[worker].popleft()] = answer

    def _replace(self, worker: Worker) -> None:
        """Another process in the place of one that died."""
        self._died += 1
        if self._died > MOST_REPLACED:
            raise GenerationError(
                f"stream: worker processes were killed {self._died} times (out of memory?); give "
                f"fewer than {len(self._given)}"
            )
        worker.end()
        given, another = self._given.pop(worker), Worker(self._make)
        self._given[another] = given
        for slot in given:
            another.pipe.send(slot)


def _end(workers: dict[Worker, deque[Slot]], process: int) -> None:
    if process == os.getpid():  # not in a fork, whose parent's they are
        for worker in workers:
            worker.end()
    workers.clear()


LEAST_SCENES = 3
"""Worlds that a folder holds at least: one a split."""


@dataclass(frozen=True, kw_only=True)
class Component(Units):
    """All that one dataset's samples depend on, but for their number; `tudf` is not among them.

    Raises DatasetError for another split, an engine that is not to be had, and a split without
    worlds.
    """

    label: str
    """What it is called, for people: a kind, or a file."""

    def __post_init__(self) -> None:
        if self.split not in SPLITS:
            raise DatasetError(
                f"stream: has no split {short(self.split)}; expected one of {', '.join(SPLITS)}"
            )
        find_engine(self.engine)
        if isinstance(self.source, SceneWorlds) and not self.source.scenes[self.split]:
            raise SceneError(
                f"{self.label}: no world of it is in the {self.split} split; give a folder of "
                f"{LEAST_SCENES} worlds or more"
            )

    @property
    def viewpoints(self) -> int:
        """Samples of a unit."""
        return self.recipe.flight.viewpoints

    def described(self) -> Json:
        """What decides the samples, as plain JSON values."""
        return {
            "split": self.split,
            "seed": self.seed,
            "generator": GENERATOR,
            "recipe": msgspec.to_builtins(recipe_entry(self.recipe)),
            "scenes": self.source.describe(),
        }

    def fingerprint(self) -> str:
        """A digest of `described`."""
        return sha256_of(json.dumps(self.described(), sort_keys=True).encode())


def component_of(what: Any, *, seed: int, split: str, engine: str) -> Component:
    """The component that `what` names: a kind, as ``module:Class`` if it is a user's own; a recipe,
    or its TOML file; an MJCF file, or a folder of them, dealt to the splits as `generate` deals it;
    a Component stays as it is.

    Raises RecipeError, SceneError and DatasetError.
    """
    if isinstance(what, Component):
        return what
    source: SceneWorlds | None = None
    if isinstance(what, Recipe):
        label, recipe = graded(what.kind, what.difficulty), what
    elif isinstance(what, str | Path):
        label, path = str(what), Path(what)
        is_file = isinstance(what, Path) or path.is_dir() or path.suffix in (".toml", *WORLD_FILES)
        is_own = isinstance(what, str) and ":" in what and not path.exists()
        if what in KINDS.builtin or is_own or not is_file:
            recipe = preset(label)
        elif path.suffix == ".toml":
            recipe = read_recipe(path)
        else:
            source = _scenes(path, seed)
            recipe = source.suited(preset("scene"))
    else:
        raise RecipeError(
            f"stream of {short(what)}: expected a kind's name, a recipe or its file, an MJCF file "
            f"or a folder of them"
        )
    if source is None and recipe.world is None:
        raise RecipeError(
            f'stream of {label}: kind "scene" draws no worlds; give the MJCF file or folder, or a '
            "scenegen.streams.mixture.Component of the recipe and its worlds"
        )
    return Component(
        label=label,
        recipe=recipe,
        source=source or DrawnWorlds(recipe),
        seed=seed,
        split=split,
        engine=engine,
    )


def _scenes(path: Path, seed: int) -> SceneWorlds:
    """The worlds of a file, all for training, or of a folder, dealt to all three splits."""
    counts = dict.fromkeys(SPLITS, 1)
    if path.is_dir():
        if len(world_files(path)) < LEAST_SCENES:
            raise SceneError(
                f"{path}: fewer than {LEAST_SCENES} worlds, and a stream deals some to each split; "
                "add worlds, or give one file, which is all for train"
            )
    else:
        counts |= {"val": 0, "test": 0}
    return read_scenes(path, counts, seed=seed)


class Mixture:
    """Components by weight, whose units come in a fixed order."""

    def __init__(self, components: Sequence[Component], weights: Sequence[Any]):
        """Raises RecipeError for no component, one that is there twice, ones of different grids,
        and weights that are no proportions."""
        if not components:
            raise RecipeError(
                "stream: nothing to draw from; name a kind of world, such as 'pillar'"
            )
        bounds = [one.recipe.known for one in components if one.recipe.known is not None]
        if bounds:  # drawn worlds beside maps of real places say that they know all
            components = [
                replace(one, recipe=replace(one.recipe, known=one.recipe.known or bounds[0]))
                for one in components
            ]
        self.components = tuple(components)
        _check_alike(self.components)
        # weights are of samples, of which a component's units hold `viewpoints` each
        shares = [
            fraction(weight, component.label) / component.viewpoints
            for weight, component in zip(weights, components, strict=True)
        ]
        total = sum(shares)
        shares = [share / total for share in shares]
        denominator = math.lcm(*(share.denominator for share in shares))
        self.units = tuple(int(share * denominator) for share in shares)
        """Units of each component in a round."""
        if sum(self.units) > MOST_UNITS_IN_ROUND:
            named = ", ".join(
                f"{component.label} {short(weight)}"
                for component, weight in zip(components, weights, strict=True)
            )
            raise RecipeError(
                f"stream: weights {named} come round after {short(sum(self.units))} flights, "
                f"expected {MOST_UNITS_IN_ROUND} at most; give proportions such as 2 and 1"
            )
        # the units of each component lie evenly spread in the round
        places = sorted(
            (Fraction(2 * unit + 1, 2 * count), number, unit)
            for number, count in enumerate(self.units)
            for unit in range(count)
        )
        self._round = [(number, unit) for _, number, unit in places]
        """A component's number, and that of one of its units, in the order of samples."""
        self._start = np.cumsum([0, *(components[number].viewpoints for number, _ in self._round)])
        """The first sample of each of these in a round; at last, how many it has."""

    @property
    def row(self) -> int:
        """Samples of a world that come one after the other, whichever component they are of: the
        greatest number that divides every unit."""
        return math.gcd(*(component.viewpoints for component in self.components))

    def place(self, index: int) -> tuple[Slot, int]:
        """(which unit of which component, the sample's place in it) of a sample of the mixture."""
        turn, rest = divmod(index, int(self._start[-1]))
        within = int(np.searchsorted(self._start, rest, side="right")) - 1
        component, number = self._round[within]
        return (component, turn * self.units[component] + number), rest - int(self._start[within])


def parts_of(worlds: Any) -> list[tuple[Any, Any]]:
    """(what, weight) of every part of a mixture: a mapping of weights, a list of parts or of pairs,
    or one part."""
    if isinstance(worlds, Mapping):
        return list(worlds.items())
    if isinstance(worlds, list | tuple):
        return [
            part if isinstance(part, tuple) and len(part) == 2 else (part, 1) for part in worlds
        ]
    return [(worlds, 1)]


def _check_alike(components: Sequence[Component]) -> None:
    first, seen = components[0], dict[str, str]()
    for component in components:
        for what in ("grid", "known"):
            theirs, ours = getattr(component.recipe, what), getattr(first.recipe, what)
            if theirs != ours:
                raise RecipeError(
                    f"stream: the {what} of {component.label} is {theirs}, that of {first.label} "
                    f"is {ours}; a stream has one {what}: mix recipes that share it"
                )
        digest = component.fingerprint()
        if digest in seen:
            raise RecipeError(
                f"stream: {component.label} is there twice, as {seen[digest]}; name it once, and "
                f"give a weight"
            )
        seen[digest] = component.label
