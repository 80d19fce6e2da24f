"""What readers rely on in a manifest, checked before they do: it may come from a stranger."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarsim import GridSpec, Sensor
from lidarsim.noise import STAGES
from scenegen import SPLITS
from scenegen.dataset import manifest
from scenegen.dataset.layout import Layout, layout_of
from scenegen.dataset.parts import (
    NAMES,
    PARTS,
    noise_of,
    rays_named,
    schema_of,
    sensor_of,
)
from scenegen.dataset.rules import (
    COUNT,
    DIGEST,
    FILE_RULE,
    FLAG,
    LIST,
    RECIPE_RULES,
    REJECTED,
    SOURCES_RULE,
    TABLE,
    TEXTS,
    Numbering,
    Rule,
    check,
    checked,
    optional,
    ruled,
    text,
    whole,
)
from scenegen.errors import (
    BrokenError,
    DatasetError,
    NewerError,
    RecipeError,
    printable,
    raised_as,
    short,
)
from scenegen.files import Json
from scenegen.limits import (
    MOST_KIND_NAME,
    MOST_SAMPLES_IN_SHARD,
    MOST_SEED,
    MOST_VIEWPOINTS,
)
from scenegen.recipes import graded, kind_names
from scenegen.sample import DERIVED, FIELDS, GROUPS, Schema
from scenegen.worlds.mapping import Known, Mapper, Sensing

if TYPE_CHECKING:  # which imports what draws worlds
    from scenegen.recipe import Recipe

_ABSENT = Rule(lambda value: value is None, "none")
_SOURCE = {"digest": optional(DIGEST), "parameters": TABLE, "taken": LIST}
_RECIPE: Json = dict.fromkeys(RECIPE_RULES) | {"version": 0, "flight": {}, "accept": {}}


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A shard, as the manifest lists it."""

    file: str = ruled(FILE_RULE)
    worlds: str = ruled(FILE_RULE)
    split: str = ruled(text("|".join(SPLITS), "train, val or test"))
    samples: int = ruled(whole(1, MOST_SAMPLES_IN_SHARD))
    first_world: int = ruled(COUNT)
    sha256: str = ruled(DIGEST)
    worlds_sha256: str = ruled(DIGEST)
    source: int = 0
    """Which of the manifest's `homes` its samples were made for."""
    start: int = 0
    """Place of its first sample in that dataset's split."""
    stop: int = 0
    """One more than that of its last."""

    @property
    def sums(self) -> tuple[str, str]:
        """The SHA-256 of its two files."""
        return self.sha256, self.worlds_sha256

    @property
    def cut(self) -> bool:
        """Whether some of the samples between were left out."""
        return self.samples < self.stop - self.start


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """A manifest whose values have the types and the bounds that readers rely on."""

    parameters: Json
    """The part of the file that is known before anything is drawn, as it stands there."""
    generator: int = ruled(whole(1, MOST_SEED))
    """The generator that made the dataset, see `scenegen.GENERATOR`."""
    kind: str = ruled(
        text(rf"(?=.{{1,{MOST_KIND_NAME}}}$)\w[\w.-]*(:\w+)?", "the name of a kind of worlds")
    )
    seed: int = ruled(optional(whole(0, MOST_SEED)))
    """None where its `sources` have different ones, and never in a dataset without `sources`."""
    counts: Mapping[str, int] = ruled(TABLE)
    """Samples that each split is to hold."""
    tables: Json
    """The recipe as it stands in the file: `version`, `flight`, `accept`, `world` or `scenes`, and
    the `difficulty` where it is not medium."""
    fields: tuple[str, ...]
    """Names of the fields that shards store."""
    grid: GridSpec
    folder: Path = field(compare=False)
    """Where the file lies."""
    rays: Mapping[str, str] = field(default_factory=dict)
    """Where the tables of rays of its sensors lie, by their SHA-256."""
    engine: str = ruled(text(r"[A-Za-z_][\w.:]{0,199}", "the name of an engine"))
    """What cast the rays; never imported unless it is one of ours."""
    noise: Json | None
    """`stages` as text, `bound_m` and `version`; None for clean ranges. Never imported unless
    `noise_is_ours`."""
    labels: Json | None
    """What the samples' labels mean: `by` what geoms are of a class, and the `classes`; None
    without labels."""
    rescan: Mapping[str, Any] | None = ruled(optional(TABLE))
    """The `digest` of the dataset whose worlds and poses were scanned again; None where they were
    drawn."""
    mapping: Mapper
    """How maps are made."""
    known: Known | None
    """How much must be known where a sensor scans a real place; None where no world is one."""
    sources: tuple["Manifest", ...] = ()
    """The datasets that its samples were made for, each without shards; none where they were made
    for this one."""
    shard_samples: int = ruled(whole(1, MOST_SAMPLES_IN_SHARD))
    software: Mapping[str, str] = ruled(TEXTS)
    complete: bool = ruled(FLAG)
    shards: tuple[Entry, ...]
    rejected: Mapping[str, Mapping[str, int]] = ruled(TABLE)
    """Rejections by reason, of `worlds` and of `viewpoints`."""
    digest: str | None = ruled(optional(DIGEST))
    """The digest of all samples; None as long as shards are missing."""
    named: str | None = field(default=None, compare=False)
    """A kind of a user's own that the user named, so that its module may be imported."""

    @property
    def files(self) -> dict[str, str]:
        """Every file that the manifest lists, with its SHA-256."""
        found = {name: sha256 for sha256, name in self.rays.items()}
        for entry in self.shards:
            found |= {entry.file: entry.sha256, entry.worlds: entry.worlds_sha256}
        return found

    @cached_property
    def lidar(self) -> Sensor:
        """The sensor. Raises BrokenError where the table of its rays is damaged."""
        entry = self.parameters["lidar"]
        return sensor_of(entry, self.folder, self.rays.get(entry.get("sha256"), ""))

    @property
    def homes(self) -> tuple["Manifest", ...]:
        """What its samples were made for: its `sources`, or this dataset."""
        return self.sources or (self,)

    @property
    def settings(self) -> tuple[Sensing, ...]:
        """How the samples of each of its `homes` were sensed."""
        return tuple(Sensing(home.lidar, home.mapping, home.noise_stages) for home in self.homes)

    @cached_property
    def schema(self) -> Schema:
        """Which fields its samples have."""
        return schema_of(self)

    @cached_property
    def layout(self) -> Layout:
        """What every shard has to hold."""
        return layout_of(self.fields, self.schema)

    @cached_property
    def fingerprint(self) -> str:
        """What every shard carries, so that it is not taken for another dataset's."""
        return manifest.fingerprint(self.parameters)

    def home(self, entry: Entry) -> "Manifest":
        """What a shard's samples were made for: one of the `sources`, or this dataset."""
        return self.homes[entry.source]

    @property
    def scenes(self) -> Mapping[str, Sequence[Mapping[str, str]]] | None:
        """Worlds from MJCF files, by split: {"file", "sha256"}; None where a recipe drew them."""
        return self.tables.get("scenes") if self.kind == "scene" else None

    def numbering(self, split: str) -> Numbering:
        """How a split's samples are numbered. Raises BrokenError where the recipe does not say."""
        flight = self.tables.get("flight", {})
        check(flight, {"viewpoints": whole(1, MOST_VIEWPOINTS)}, "recipe.flight")
        scenes = None if self.scenes is None else max(len(self.scenes.get(split, ())), 1)
        return Numbering(viewpoints=flight["viewpoints"], scenes=scenes)

    @cached_property
    def first_worlds(self) -> dict[tuple[str, int], int]:
        """What readers add to the number of a world that a sample bears, by its split and which of
        the `homes` it was made for, so that worlds of a split have numbers of their own."""
        found = {(split, 0): 0 for split in SPLITS}
        for n, source in enumerate(self.sources[:-1]):
            for split in SPLITS:
                worlds = source.numbering(split).count(source.counts[split])
                found[split, n + 1] = found[split, n] + worlds
        return found

    @property
    def noise_stages(self) -> str:
        """Its stages of noise as text; "" for clean ranges."""
        return self.noise["stages"] if self.noise else ""

    @property
    def noise_is_ours(self) -> bool:
        """Whether its noise is scenegen's own, so that reading imports nothing that is named."""
        stages = filter(None, self.noise_stages.split(","))
        return all(stage.partition(":")[0] in STAGES.builtin for stage in stages)

    @property
    def graded(self) -> str:
        """Its kind, and its difficulty where that is not medium: "maze-hard"."""
        return graded(self.kind, self.tables.get("difficulty") or "medium")

    @property
    def drawn(self) -> bool:
        """Whether the recipe can draw the worlds again: they are of a kind known here, or named by
        the user."""
        return self.kind in (*kind_names(), self.named)

    @cached_property
    def recipe(self) -> "Recipe":
        """What the tables spell out; without its world where the kind is not `drawn`, and without
        noise that is not ours: no module is imported because a manifest names it. Raises
        BrokenError."""
        from scenegen.recipe import make_recipe
        from scenegen.worlds.labels import Labels

        left = ("version", "scenes", *(() if self.drawn else ("world", "difficulty")))
        tables = {name: table for name, table in self.tables.items() if name not in left}
        tables["grid"] = asdict(self.grid)
        for name in (name for name in NAMES if name in self.tables):
            raise BrokenError(f"recipe.{name}: is there, expected {name} beside recipe")
        noise = noise_of(self.noise if self.noise_is_ours else None, self.lidar.max_range_m)
        with raised_as(BrokenError, of=(RecipeError, ValueError)):
            kind = self.kind if self.drawn else "scene"
            found = make_recipe(kind, tables, lidar=self.lidar)
            said = self.labels and {**self.labels, "classes": tuple(self.labels["classes"])}
            labels = Labels(**said) if said else None
            return replace(
                found, noise=noise, labels=labels, mapping=self.mapping, known=self.known
            )


def parse(document: Json, folder: Path, named: str | None = None) -> Manifest:
    """The content of the manifest in `folder`, checked; `named` is the kind that the user named.

    Raises BrokenError with what is wrong, where, and what was expected.
    """
    values = manifest.BEFORE | dict(document)
    plain = checked(Manifest, values, "")
    tables = {"shards": LIST, "fields": LIST, "recipe": TABLE, "sources": optional(SOURCES_RULE)}
    check(values, tables, "")
    check(plain["counts"], dict.fromkeys(SPLITS, COUNT), "counts")
    check(plain["rejected"], REJECTED, "rejected")
    check(_RECIPE | values["recipe"], RECIPE_RULES, "recipe")
    parts: Json = {}
    for part in PARTS:
        if part.since == manifest.VERSION:
            check(values, {part.name: TABLE}, "")
        parts[part.name] = part.read(values[part.name], parts)
    if values["rescan"] is not None:
        check(values["rescan"], {"digest": DIGEST}, "rescan", ("digest",))
    if values["version"] != (expected := manifest.version_of(values)):
        there = ", ".join(name for name in manifest.MINOR if values[name] is not None)
        named = there or "nothing of a minor version"
        raise BrokenError(f"version = {short(values['version'])}: expected {expected} with {named}")
    _check_fields(values["fields"], parts)
    sources = _sources(values, folder, named)
    shards = _entries(values["shards"], sources)
    names = Counter(name for entry in shards for name in (entry.file, entry.worlds))
    for name, count in names.most_common(1):
        if count > 1:
            raise BrokenError(f"shards: {name!r} is listed {count} times, expected once")
    return Manifest(
        **plain,
        **{name: value for name, value in parts.items() if name != "lidar"},
        sources=sources,
        parameters=manifest.parameters_of(document),
        tables=values["recipe"],
        fields=tuple(values["fields"]),
        folder=folder,
        rays=rays_named(values),
        shards=shards,
        named=named,
    )


def _check_fields(names: Sequence[Any], parts: Json) -> None:
    """Raise BrokenError unless the fields `names` are what samples of these `parts` have, with the
    derived ones or without them."""
    check(dict.fromkeys(name for name in names if isinstance(name, str)), {}, "fields", FIELDS)
    groups = [group for group, own in GROUPS.items() if any(name in names for name in own)]
    every = [name for name, about in FIELDS.items() if about["group"] in groups]
    if list(names) not in (every, [name for name in every if name not in DERIVED]):
        raise BrokenError(
            f"fields = {short(names)}: expected all fields of whole groups, or all but the "
            f"derived ones"
        )
    for part in PARTS:
        if part.group and part.brings(parts[part.name]) != (part.group in groups):
            fault = f"expected exactly where `fields` names those of {part.group}"
            raise BrokenError(f"{part.name}: {fault}")


def _sources(found: Json, folder: Path, named: str | None) -> tuple[Manifest, ...]:
    """The datasets that the samples of a manifest, `found`, were made for, which agree with it; see
    `parse` for `named`. Raises BrokenError."""
    if found["sources"] is None:
        check(found, {"seed": whole(0, MOST_SEED)}, "")
    sources, every = [], []
    for n, entry in enumerate(found["sources"] or ()):
        at = f"sources.{n}"
        check(entry, _SOURCE, at, _SOURCE)
        given = manifest.BEFORE | entry["parameters"]
        check(given, {"sources": _ABSENT}, f"{at}.parameters")
        every.append(given)
        for name in manifest.differing(found, [given]):
            if name not in manifest.MAY_DIFFER:
                raise BrokenError(f"{at}.parameters.{name}: expected what the manifest itself says")
        whole_of = {"complete": True, "shards": [], "rejected": {"worlds": {}, "viewpoints": {}}}
        whole_of["digest"] = entry["digest"]
        with raised_as(BrokenError, f"{at}.parameters: ", of=(BrokenError, KeyError)):
            source = parse({**entry["parameters"], **whole_of}, folder, named)
            source.numbering("train")
        sources.append(source)
    if (differ := manifest.differing(found, every) or None) != found["differ"]:
        raise BrokenError(f"differ = {short(found['differ'])}: expected {differ}, as sources say")
    rays = rays_named(found)
    return tuple(replace(source, rays=rays) for source in sources)


def _entries(listed: Sequence[Any], sources: Sequence[Manifest]) -> tuple[Entry, ...]:
    """The shards that a manifest lists. Without `sources`, each begins where the one before it in
    its split ended. Raises BrokenError where one cannot be of the source that it names."""
    entries, ends = list[Entry](), dict.fromkeys(SPLITS, 0)
    of_source = {"source": whole(0, len(sources) - 1), "start": COUNT, "stop": COUNT}
    for n, given in enumerate(listed):
        at = f"shards.{n}"
        entry = checked(Entry, given, at)
        split, samples = entry["split"], entry["samples"]
        if not sources:
            entry |= {"start": ends[split], "stop": ends[split] + samples}
            ends[split] += samples
        else:
            check(given, of_source, at)
            entry |= {name: given[name] for name in of_source}
            start, stop = entry["start"], entry["stop"]
            most = sources[entry["source"]].counts[split]
            if not samples <= stop - start or stop > most:
                raise BrokenError(
                    f"{at}: {samples} samples from {start} to {stop}: expected as many places, up "
                    f"to {most}"
                )
        entries.append(Entry(**entry))
    return tuple(entries)


def load(folder: Path, name: str = "") -> Manifest:
    """The manifest of `folder`, which errors call `name`.

    Raises DatasetError for a folder without one, for a value of a wrong type or beyond reason, and
    for shards that are no dataset's files, or not as many samples as the counts say.
    """
    document = manifest.read(folder, name)
    try:
        found = parse(document, folder)
        for split, asked in found.counts.items():
            total = sum(entry.samples for entry in found.shards if entry.split == split)
            if total > asked or (found.complete and total < asked):
                raise BrokenError(f"counts.{split} = {asked}, but its shards hold {total} samples")
        return found
    except BrokenError as error:
        where, wrong = f"{name or folder}: {manifest.NAME}", printable(error)[:300]
        newer = isinstance(error, NewerError) or manifest.is_later(document)
    if newer:
        raise DatasetError(f"{where}: a newer scenegen wrote it: {wrong}; read it with that one")
    raise DatasetError(f"{where} is damaged: {wrong}; copy the dataset again, or generate it")
