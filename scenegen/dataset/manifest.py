"""The manifest, `dataset.json`, as it stands in the file: written, read, and compared. `trust`
checks its values."""

import difflib
import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarsim.engines import DEFAULT, MUJOCO
from lidarsim.parameters import MOST_SHOWN
from scenegen import GENERATOR, SPLITS, __version__
from scenegen.dataset.parts import NAMES, PARTS, entries, plain, schema_of
from scenegen.errors import DatasetError, StoreError, printable, short, whole_number
from scenegen.files import Json, sha256_of, write_whole
from scenegen.limits import (
    MOST_DEPTH,
    MOST_MANIFEST_BYTES,
    MOST_SAMPLES_IN_SHARD,
    MOST_SEED,
    USUAL_IN_SHARD,
)
from scenegen.run.software import software
from scenegen.stores import ConflictError, Place, Store, read_at

if TYPE_CHECKING:  # these draw worlds, and import what that takes
    from scenegen.dataset.shard import ShardReport
    from scenegen.recipe import Recipe
    from scenegen.source import Source

NAME = "dataset.json"
FORMAT = "scenegen-dataset"
VERSION = 1
"""The major version of the format."""
VERSIONS = (VERSION, 1.2, 1.3, 1.4, "1.5", "1.6")
"""All of the format, as they stand in the file, in order; from 1.5 on as text, for 1.10 is no
1.1."""
SINCE: Mapping[str, int | float | str] = {
    **{part.name: part.since for part in PARTS},
    **{"rescan": 1.2, "sources": 1.4, "differ": "1.6"},
}
"""Entries, and the first version of the format that has them: a manifest is of the latest one that
any of its entries asks for, and readers of earlier versions refuse it. Whatever they would refuse
is to raise the version."""

MINOR = tuple(name for name, since in SINCE.items() if since != VERSION)
"""Entries that raise a manifest's version."""
UNNAMED: Json = {"generator": 1, "engine": MUJOCO}
BEFORE: Json = {**UNNAMED, **dict.fromkeys(MINOR)}
"""What a manifest says by not naming it."""
OF_SHARDS = ("complete", "shards", "rejected", "digest")
"""What a manifest says besides the dataset's parameters."""
ALIKE = ("format", "generator", "fields", *NAMES)
"""Parameters in which all datasets agree whose samples are in one, but for those that `differ`
names."""
MAY_DIFFER = ("fields", "lidar", "noise", "mapping")
"""Those that it may name."""
SEVERAL = "several"
"""What a manifest says for a text in which the datasets differ that its samples were made for."""


def parameters(
    recipe: "Recipe",
    source: "Source",
    *,
    seed: int,
    counts: Mapping[str, int],
    compact: bool = False,
    shard_samples: int = USUAL_IN_SHARD,
    engine: str = DEFAULT,
) -> Json:
    """The part of the manifest that is known before anything is drawn, and decides everything
    after.

    Args:
        recipe: What samples hold.
        source: Where worlds come from.
        seed: What everything is drawn by.
        counts: Samples of each split.
        compact: Whether fields that follow from others are left out.
        shard_samples: About how many samples a shard has.
        engine: Names what casts the rays; see `lidarsim.engines.ENGINES`.

    Raises:
        DatasetError: A number is beyond those that readers take.
    """
    more, scenes = entries(recipe), source.describe()
    return {
        "format": FORMAT,
        "version": version_of(more),
        "generator": GENERATOR,
        "kind": recipe.kind,
        "seed": whole_number("--seed", seed, 0, MOST_SEED),
        "counts": {split: counts[split] for split in SPLITS},
        "recipe": plain(recipe.resolved() | ({"scenes": scenes} if scenes else {})),
        "fields": list(schema_of(recipe).stored(compact=compact)),
        **more,
        "shard_samples": whole_number("--shard-samples", shard_samples, 1, MOST_SAMPLES_IN_SHARD),
        **({} if engine == MUJOCO else {"engine": engine}),
        "software": software(),
    }


def version_of(given: Json) -> int | float | str:
    """The version of a manifest that has the entries `given`, as it stands in the file."""
    asked = [since for name, since in SINCE.items() if given.get(name) is not None]
    return max((VERSION, *asked), key=VERSIONS.index)


def is_later(document: Json) -> bool:
    """Whether a manifest says that a later version of scenegen wrote it."""
    software = document.get("software")
    said = software.get("scenegen") if isinstance(software, dict) else ""
    theirs, ours = (
        list(map(int, re.findall(r"[0-9]{1,9}", str(one)[:50]))) for one in (said, __version__)
    )
    return theirs > ours


def _pair(version: Any) -> tuple[int, ...]:
    """A version as whole numbers, major first; (0, 0) for what is none."""
    numbers = re.fullmatch(r"([0-9]{1,9})(?:\.([0-9]{1,9}))?", short(version).strip("'"))
    return (int(numbers[1]), int(numbers[2] or 0)) if numbers else (0, 0)


def parameters_of(document: Json) -> Json:
    """The `parameters` of a manifest, as they stand in it: all that it does not say of its
    shards."""
    return {name: value for name, value in document.items() if name not in OF_SHARDS}


def completed(document: Json) -> Json:
    """The `parameters` of a manifest, with the generator and the engine, where it does not name
    them."""
    return {**UNNAMED, **parameters_of(document)}


def fingerprint(given: Json) -> str:
    """A digest of `parameters`, the same for the same dataset."""
    return sha256_of(json.dumps(given, sort_keys=True).encode())


def differing(given: Json, others: Iterable[Json]) -> list[str]:
    """Those of `ALIKE` in which `others` are not as the parameters `given`."""
    return [name for name in ALIKE if any(one.get(name) != given.get(name) for one in others)]


def differences(
    there: Json, asked: Json, words: tuple[str, str] = ("there", "asked for"), prefix: str = ""
) -> list[str]:
    """Where two sets of parameters differ.

    Args:
        there: The first set.
        asked: The second set.
        words: What the values of the first and of the second set are called.
        prefix: Stands before every name.

    Returns:
        Lines such as "grid.voxel is 0.2 there, 0.1 asked for": nested names are joined by dots, and
        the items of a list of tables named by their places.
    """
    found = []
    for name in [*there, *(name for name in asked if name not in there)]:
        old, new = (_numbered(given.get(name, "absent")) for given in (there, asked))
        if isinstance(old, dict) and isinstance(new, dict):
            found += differences(old, new, words, f"{prefix}{name}.")
        elif old != new:
            found.append(
                f"{short(f'{prefix}{name}')[1:-1]} is {_said(old)} {words[0]}, "
                f"{_said(new)} {words[1]}"
            )
    return found


def _numbered(value: Any) -> Any:
    """A list of tables as a table of them by their places; anything else as it is."""
    tables = isinstance(value, list) and value and isinstance(value[0], dict)
    return dict(enumerate(value)) if tables else value


def _said(value: Any) -> str:
    """A parameter as JSON writes it, cut where it is long; of digests, the first digits."""
    text = re.sub(r'"(\w{8})\w{56}"', r'"\1…"', json.dumps(value))
    return text if len(text) <= MOST_SHOWN else f"{text[: MOST_SHOWN - 3]}..."


def assemble(given: Json, reports: Sequence["ShardReport"], *, complete: bool) -> Json:
    """The manifest of the shards reported, in order."""
    rejected = {
        what: sum((Counter(report.rejected[what]) for report in reports), Counter[str]())
        for what in ("worlds", "viewpoints")
    }
    digest = sha256_of(b"".join(report.digests for report in reports))
    return {
        **given,
        "complete": complete,
        "shards": [report.entry() for report in reports],
        "rejected": {what: dict(sorted(counts.items())) for what, counts in rejected.items()},
        "digest": digest if complete else None,
    }


def write(folder: Place, manifest: Json) -> None:
    """Replace the manifest of `folder`; at a store, the one that was read last.

    If another run has put one there meanwhile, a complete one stays, and this one takes the place
    of any other; they may list other shards, but none differently. Raises StoreError where it is of
    another dataset.
    """
    content = encode(manifest)
    if not isinstance(folder, Store):
        write_whole(folder / NAME, content)
        return
    while True:  # until no other run puts one between
        try:
            folder.replace(NAME, content)
            return
        except ConflictError:
            there = read(folder)
            if encode(there) == content:
                return
        if parameters_of(there) != parameters_of(manifest):
            raise StoreError(
                f"{folder}: another run has begun another dataset there; choose another --out for "
                f"one"
            )
        if there["complete"]:
            if manifest["complete"]:
                raise StoreError(
                    f"{folder}: another run has completed it with other bytes; give the same "
                    f"command again"
                )
            return


def encode(manifest: Json) -> bytes:
    """The content of the file."""
    return (json.dumps(manifest, indent=1) + "\n").encode()


def read(folder: Place, name: str = "") -> Json:
    """The manifest of `folder`, which errors call `name`, as it stands there, its values unchecked.

    Raises DatasetError where it has none that this version can read.
    """
    path = f"{name or folder}/{NAME}"
    try:
        manifest = json.loads(read_at(folder, NAME, MOST_MANIFEST_BYTES).decode())
        if _depth(manifest) > MOST_DEPTH:
            raise ValueError(f"it nests deeper than {MOST_DEPTH} levels, which no manifest does")
    except FileNotFoundError:
        here = Path(str(folder))
        lacks = f"it has no {NAME}" if here.exists() else "there is no such folder"
        inner, others = (
            [str(near.parent) for near in place.glob(f"*/{NAME}")] for place in (here, here.parent)
        )
        for near in sorted(inner)[:1] or difflib.get_close_matches(str(folder), others, 1, 0.8):
            lacks += f"; did you mean {near}?"
        raise DatasetError(
            f"{folder}: not a dataset, {lacks}; make one with `scenegen generate`"
        ) from None
    except (OSError, ValueError, RecursionError) as error:
        raise DatasetError(
            f"{path}: cannot be read ({printable(error)[:200]}); copy the dataset again, or "
            "generate it in another folder"
        ) from None
    if (
        not isinstance(manifest, dict)
        or manifest.get("format") != FORMAT
        or "shards" not in manifest
    ):
        raise DatasetError(f'{path}: not a scenegen dataset, expected "format": "{FORMAT}"')
    if (there := manifest.get("version")) not in VERSIONS:
        more = (
            "a newer scenegen wrote it; read it with that one"
            if _pair(there) > _pair(VERSIONS[-1])
            else "copy the dataset again"
        )
        raise DatasetError(
            f"{path}: format version {short(there)}, this scenegen reads up to {VERSIONS[-1]}; "
            f"{more}"
        )
    return manifest


def _depth(value: Any) -> int:
    """How deep a JSON value nests."""
    depth, level = 0, [value]
    while level := [one for one in level if isinstance(one, (dict, list))]:
        depth += 1
        level = [
            inner for one in level for inner in (one.values() if isinstance(one, dict) else one)
        ]
    return depth
