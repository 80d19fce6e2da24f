"""Sources of a stream: components, mixtures of them, and worker processes that draw units in
advance."""

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

from lidarsim.parameters import short_repr
from scenegen import GENERATOR, SPLITS
from scenegen.base.errors import DatasetError, GenerationError, RecipeError, SceneError
from scenegen.base.files import Json
from scenegen.base.limits import MAX_UNITS_IN_ROUND
from scenegen.base.paths import WORLD_FILES
from scenegen.base.reading import sha256_of
from scenegen.base.workers import MAX_REPLACED, Worker
from scenegen.dataset.build import recipe_entry
from scenegen.dataset.shard import Units, find_engine
from scenegen.draw.mixture import fraction
from scenegen.draw.sample import FIELDS, Sample, Schema
from scenegen.draw.source import DrawnWorlds, SceneWorlds, read_scenes, world_files
from scenegen.truth import distance_field
from scenegen.worlds.kinds import KINDS, graded
from scenegen.worlds.recipe import Recipe, preset, read_recipe

PackedUnit = tuple[bytes, ...]
"""Packed samples of a unit."""
Slot = tuple[int, int]
"""Key of a unit: number of its component in the mixture, and number of the unit there."""
LEVEL = 1
"""Compression level, as in shards."""


def record_type(schema: Schema) -> np.dtype:
    """NumPy type of a packed sample: booleans as bits, other fields as on disk. `tudf` is omitted:
    it follows from occupancy, and has ten times the size of all the rest."""
    columns: list[tuple[Any, ...]] = []
    for name in schema.names:
        if name == "tudf":
            continue
        shape = schema.shape(name)
        if _is_flags(name):
            # eight flags a byte, rounded up
            columns.append((name, "u1", -(-math.prod(shape) // 8)))
        else:
            columns.append((name, FIELDS[name]["dtype"], shape))
    return np.dtype(columns)


def _is_flags(name: str) -> bool:
    """Whether a field is boolean, which records hold as bits."""
    return bool(FIELDS[name]["dtype"] == "bool")


def pack_sample(sample: Sample, kind: np.dtype) -> bytes:
    """Compress a sample.

    Args:
        kind: `record_type` of its schema.
    """
    record = np.zeros((), kind)
    for name in kind.names or ():
        value = getattr(sample, name)
        record[name] = np.packbits(value) if _is_flags(name) else value
    return isal.isal_zlib.compress(record.tobytes(), LEVEL)


def unpack(packed: bytes, kind: np.dtype, schema: Schema) -> Sample:
    """Unpack a sample. Its arrays are writable.

    Args:
        kind: `record_type` of `schema`.
    """
    record = np.frombuffer(isal.isal_zlib.decompress(packed), kind)[0]

    def _find(sample: Sample, name: str) -> Any:
        if name == "tudf":
            return distance_field(sample.occupancy, schema.grid)
        value: np.ndarray = record[name]
        if _is_flags(name):
            shape = schema.shape(name)
            return np.unpackbits(value, count=math.prod(shape)).view(bool).reshape(shape)
        # a Python number, or a writable copy: the record itself is read-only
        return value.item() if FIELDS[name]["axes"] == "" else value.copy()

    return Sample.lazy(schema.names, _find, lidar=schema.lidar, grid=schema.grid)


class Ahead:
    """Worker processes that draw units in the order of requests.

    They end with this object, and with this process. A worker that dies is replaced, and its units
    are requested again.
    """

    def __init__(self, make: Callable[[Slot], PackedUnit], workers: int):
        self._make, self._died = make, 0
        self._given = {Worker(make): deque[Slot]() for _ in range(workers)}
        self._done: dict[Slot, tuple[bool, Any]] = {}
        # unlike a `__del__`, it runs at exit before the modules that it needs are gone
        self.close = weakref.finalize(self, _end, self._given, os.getpid())
        """End the processes, whatever they are doing."""

    @property
    def under_way(self) -> int:
        """Number of units that were requested, and not taken yet."""
        return len(self._done) + sum(map(len, self._given.values()))

    def __contains__(self, slot: object) -> bool:
        return slot in self._done or any(slot in queue for queue in self._given.values())

    def give(self, slot: Slot) -> None:
        """Request a unit, unless it is under way."""
        if slot not in self:
            # the worker with the shortest queue
            worker, queue = min(self._given.items(), key=lambda item: len(item[1]))
            queue.append(slot)
            with contextlib.suppress(OSError):  # it died, which `collect` notices
                worker.pipe.send(slot)

    def take(self, slot: Slot) -> PackedUnit:
        """Wait for a unit, and request it if necessary.

        Raises:
            GenerationError: if workers die repeatedly. Errors of drawing pass through.
        """
        self.give(slot)
        self.collect()
        while slot not in self._done:
            self.collect(wait=True)
        succeeded, value = self._done.pop(slot)
        if not succeeded:
            raise value
        return value

    def collect(self, *, wait: bool = False) -> None:
        """Receive finished units; with `wait`, at least one answer."""
        workers = {worker.pipe: worker for worker in self._given}
        for pipe in multiprocessing.connection.wait(workers, None if wait else 0):
            worker = workers[pipe]
            try:
                answer = worker.pipe.recv()
            except (EOFError, OSError):
                self._replace(worker)
                continue
            # the oldest request: a worker answers in the order of its pipe
            self._done[self._given[worker].popleft()] = answer

    def _replace(self, worker: Worker) -> None:
        """Replace a worker that died."""
        self._died += 1
        if self._died > MAX_REPLACED:
            raise GenerationError(
                f"stream: worker processes were killed {self._died} times (out of memory?); give "
                f"fewer than {len(self._given)}"
            )
        worker.end()
        queue, replacement = self._given.pop(worker), Worker(self._make)
        self._given[replacement] = queue
        for slot in queue:
            # drawing is deterministic: the units come out the same
            replacement.pipe.send(slot)


def _end(workers: dict[Worker, deque[Slot]], process: int) -> None:
    if process == os.getpid():  # a fork must not end workers of its parent
        for worker in workers:
            worker.end()
    workers.clear()


MIN_SCENES = 3
"""Minimum number of worlds in a folder: one for each split."""


@dataclass(frozen=True, kw_only=True)
class Component(Units):
    """One source of samples: all that its samples depend on except their number. Samples have no
    `tudf`.

    Raises DatasetError if there is no such split or engine, RecipeError if the worlds are for
    testing alone and the split is another, and SceneError if the split has no worlds.
    """

    label: str
    """Name for messages: a kind, or a file."""

    def __post_init__(self) -> None:
        if self.split not in SPLITS:
            raise DatasetError(
                f"stream: has no split {short_repr(self.split)}; expected one of "
                f"{', '.join(SPLITS)}"
            )
        self.recipe.check_splits([self.split])
        # a missing engine fails here, and not in a worker
        find_engine(self.engine)
        if isinstance(self.source, SceneWorlds) and not self.source.scenes[self.split]:
            raise SceneError(
                f"{self.label}: no world of it is in the {self.split} split; give a folder of "
                f"{MIN_SCENES} worlds or more"
            )

    @property
    def viewpoints(self) -> int:
        """Number of samples of a unit."""
        return self.recipe.flight.viewpoints

    def described(self) -> Json:
        """All that determines the samples, as JSON values."""
        return {
            "split": self.split,
            "seed": self.seed,
            "generator": GENERATOR,
            "recipe": msgspec.to_builtins(recipe_entry(self.recipe)),
            # without the engine: all give the same rays, so a saved position holds with each
            "scenes": self.source.describe(),
        }

    def fingerprint(self) -> str:
        """Digest of `described`."""
        return sha256_of(json.dumps(self.described(), sort_keys=True).encode())


def component_of(entry: Any, *, seed: int, split: str, engine: str) -> Component:
    """Make a component.

    Args:
        entry: Name of a kind, or ``module:Class`` of a user's own; a recipe or its TOML file; an
            MJCF file or a folder of them, divided among the splits as `generate` does; a Component
            is returned unchanged.
        seed: Seed of the component.
        split: "train", "val" or "test".
        engine: Name of the engine that casts rays.

    Raises:
        RecipeError: if `entry` is none of these, or the recipe is invalid.
        SceneError: if a file cannot be used as a world.
        DatasetError: if there is no such split or engine.
    """
    if isinstance(entry, Component):
        return entry
    source: SceneWorlds | None = None
    if isinstance(entry, Recipe):
        label, recipe = graded(entry.kind, entry.difficulty), entry
    elif isinstance(entry, str | Path):
        label, path = str(entry), Path(entry)
        is_file = isinstance(entry, Path) or path.is_dir() or path.suffix in (".toml", *WORLD_FILES)
        is_own = isinstance(entry, str) and ":" in entry and not path.exists()
        # a kind takes precedence over a file of the same name
        if entry in KINDS.builtin or is_own or not is_file:
            recipe = preset(label)
        elif path.suffix == ".toml":
            recipe = read_recipe(path)
        else:
            source, recipe = _scenes(path, seed).suited(preset("scene"))
    else:
        raise RecipeError(
            f"stream of {short_repr(entry)}: expected a kind's name, a recipe or its file, an "
            "MJCF file "
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
    """Worlds of a file or folder, divided as `generate` does."""
    # any number above 0: only which splits have samples decides how worlds are divided
    counts: dict[str, int | None] = dict.fromkeys(SPLITS, 1)
    if path.is_dir():
        if len(world_files(path)) < MIN_SCENES:
            raise SceneError(
                f"{path}: fewer than {MIN_SCENES} worlds, and a stream deals some to each split; "
                "add worlds, or give one file, which is all for train"
            )
    else:
        counts |= {"val": None, "test": None}
    return read_scenes(path, counts, seed=seed)


class Mixture:
    """Components by weight. Their units come in a fixed order.

    Raises RecipeError if there is no component, one is repeated, grids differ, or weights are
    invalid.
    """

    def __init__(self, components: Sequence[Component], weights: Sequence[Any]):
        if not components:
            raise RecipeError(
                "stream: nothing to draw from; name a kind of world, such as 'pillar'"
            )
        self.components = _with_known(components)
        _check_alike(self.components)
        # weights count samples, a round counts units of `viewpoints` samples
        shares = [
            fraction(weight, component.label) / component.viewpoints
            for weight, component in zip(weights, components, strict=True)
        ]
        shares = [share / sum(shares) for share in shares]
        # the shortest round in which every share is a whole number of units
        denominator = math.lcm(*(share.denominator for share in shares))
        self.units = tuple(int(share * denominator) for share in shares)
        """Number of units of each component in a round."""
        if sum(self.units) > MAX_UNITS_IN_ROUND:
            listed = ", ".join(
                f"{component.label} {short_repr(weight)}"
                for component, weight in zip(components, weights, strict=True)
            )
            raise RecipeError(
                f"stream: weights {listed} come round after {short_repr(sum(self.units))} flights, "
                f"expected {MAX_UNITS_IN_ROUND} at most; give proportions such as 2 and 1"
            )
        # spread the units of each component evenly over the round
        places = sorted(
            (Fraction(2 * unit + 1, 2 * count), number, unit)
            for number, count in enumerate(self.units)
            for unit in range(count)
        )
        self._round = [(number, unit) for _, number, unit in places]
        """Component and unit number within the round, in the order of samples."""
        self._start = np.cumsum([0, *(components[number].viewpoints for number, _ in self._round)])
        """First sample of each unit of a round, followed by the number of samples of a round."""

    @property
    def row(self) -> int:
        """Number of consecutive samples that surely belong to one world: the greatest common
        divisor of the units' sizes."""
        return math.gcd(*(component.viewpoints for component in self.components))

    def place(self, index: int) -> tuple[Slot, int]:
        """The unit of sample `index`, and its position in the unit."""
        turn, offset = divmod(index, int(self._start[-1]))
        position = int(np.searchsorted(self._start, offset, side="right")) - 1
        component, number = self._round[position]
        return (component, turn * self.units[component] + number), offset - int(
            self._start[position]
        )


def weighted_sources(worlds: Any) -> list[tuple[Any, Any]]:
    """Split the user's `worlds` into (source, weight) pairs: a mapping to weights, a list of
    sources or of pairs, or one source."""
    if isinstance(worlds, Mapping):
        return list(worlds.items())
    if isinstance(worlds, list | tuple):
        return [
            part if isinstance(part, tuple) and len(part) == 2 else (part, 1) for part in worlds
        ]
    return [(worlds, 1)]


def _with_known(components: Sequence[Component]) -> tuple[Component, ...]:
    """Give all components the thresholds for known space, if one has them: beside maps of real
    places, drawn worlds declare that all of their space is known."""
    thresholds = (part.recipe.known for part in components if part.recipe.known is not None)
    if (known := next(thresholds, None)) is None:
        return tuple(components)
    return tuple(
        replace(part, recipe=replace(part.recipe, known=part.recipe.known or known))
        for part in components
    )


def _check_alike(components: Sequence[Component]) -> None:
    """Check that components share the grid and `known`, and that none is repeated. Raises
    RecipeError."""
    first, seen = components[0], dict[str, str]()
    for component in components:
        for setting in ("grid", "known"):
            value, expected = getattr(component.recipe, setting), getattr(first.recipe, setting)
            if value != expected:
                raise RecipeError(
                    f"stream: the {setting} of {component.label} is {value}, that of {first.label} "
                    f"is {expected}; a stream has one {setting}: mix recipes that share it"
                )
        digest = component.fingerprint()
        if digest in seen:
            raise RecipeError(
                f"stream: {component.label} is there twice, as {seen[digest]}; name it once, and "
                f"give a weight"
            )
        seen[digest] = component.label
