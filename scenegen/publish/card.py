"""What is said of a published dataset: to people in the card, `README.md`, and to machines in
`croissant.json`, MLCommons' Croissant 1.1 with its responsible-AI extension. `card.md` and
`croissant.json` beside this file are their texts; here are the parts that differ between
datasets.
"""

import json
import re
import shlex
from collections.abc import Mapping, Sequence
from importlib.resources import files
from string import Template
from typing import Any

from lidarsim.engines import ENGINES, MUJOCO
from scenegen.base.files import Json
from scenegen.dataset.layout import DIGEST
from scenegen.dataset.manifest import Manifest
from scenegen.dataset.schema import NAME, VERSION, pattern_of
from scenegen.publish import LICENCES
from scenegen.view.inspect import TITLES

MOST_NAMED = 50
"""Classes that a card names."""
PAPER = (
    "Yu, Zhao, Xu: Planning-Oriented 3D Scene Completion via Coupled TUDF–Occupancy Representation "
    "Learning from Partial Observations"
)
KINDS = {
    "pillar": "random forests of round, square and oblong pillars",
    "geometric": "random spheres, boxes, cylinders and walls, standing and floating",
    "rooms": "storeys of buildings with rooms, doors, windows, ceilings and furniture",
    "street": "streets with houses, cars, poles, wires and trees",
    "forest": "forests on uneven ground",
    "cave": "caves with tunnels and chambers",
    "warehouse": "warehouses with racks, aisles, conveyors and trusses",
    "industrial": "machine halls with pipes, tanks, catwalks and scaffolds",
    "maze": "mazes in three dimensions with windows to fly through",
    "clutter": "clouds of shapes of all sizes",
    "scene": "worlds given as files",
}
FORMATS = {
    "h5": "application/x-hdf5",
    "zip": "application/zip",
    "json": "application/json",
    "npy": "application/octet-stream",
}


def facts(
    made: Manifest,
    summary: Json,
    repository: str,
    licence: str,
    *,
    tag: str,
    date: str,
    checks: Sequence[tuple[str, str]],
    pictures: str,
) -> Json:
    """The values of all placeholders of `card.md` and `croissant.json`, by name.

    Args:
        made: The dataset.
        summary: What `scenegen.view.inspect.inspect` says of it.
        repository: The repository on the Hub, user/name.
        licence: The SPDX name of the licence that it is published under.
        tag: The revision that names this content.
        date: The day of publication, YYYY-MM-DD.
        checks: Name and detail of every check that the dataset passed.
        pictures: Markdown that shows its pictures.
    """
    owner, _, name = repository.partition("/")
    licence_name, licence_url = LICENCES[licence]
    splits = summary["splits"]
    maps = "" if made.mapping.plain else f", each {made.mapping}"
    worlds = KINDS.get(made.kind, f"worlds of kind {made.kind}")
    voxels = f"{' × '.join(map(str, made.grid.shape))} voxel maps of {made.grid.voxel_m:g} m"
    return {
        **_notes(made),
        "name": name,
        "owner": owner,
        "repository": repository,
        "url": f"https://huggingface.co/datasets/{repository}",
        "tag": tag,
        "date": date,
        "year": date[:4],
        # the Hub's names for these have no version
        "hub_licence": re.sub(r"(od.+|pddl)-1\.0", r"\1", licence.lower()),
        "licence": licence_name,
        "licence_url": licence_url,
        "paper": PAPER,
        "sentence": f"{summary['samples']} pairs of a simulated LiDAR scan and the exact truth "
        f"around it, in {worlds}, as {voxels}{maps}",
        "version": f"{VERSION}.{made.tables.version}.0",
        "seed": made.seed,
        "lidar": str(made.lidar),
        "digest": made.digest,
        "centred": "" if maps else " and the sensor sits at the map's centre",
        "versions": ", ".join(f"{name} {number}" for name, number in made.software.items()),
        "voxel_m": made.grid.voxel_m,
        "truncation_m": f"{made.grid.truncation_m:g}",
        "command": command(made, repository, tag),
        "samples": summary["samples"],
        "split": next(iter(splits)),
        "data_files": "\n".join(
            f"  - split: {split}\n    path: {json.dumps(_shards(made, split))}" for split in splits
        ),
        "pictures": pictures,
        "fields": _fields(made),
        "statistics": _statistics(splits),
        "megabytes": f"{summary['bytes'] / 1e6:.1f}",
        "kilobytes": f"{summary['bytes_per_sample'] / 1e3:.1f}",
        "checks": "\n".join(f"- {check}: {detail}" for check, detail in checks),
    }


def command(made: Manifest, repository: str, tag: str) -> str:
    """What to type to make the dataset of a manifest again: by the manifest alone, where its worlds
    were drawn by a recipe."""
    drawn = made.kind != "scene" and made.like is None
    like = NAME if drawn else f"hf://{repository}@{tag}"
    words = ["scenegen", "generate", "--like", like, "--out", repository.rpartition("/")[2]]
    words += ["--kind", made.kind] if ":" in made.kind else []
    words += ["--engine", made.engine] if made.engine not in ENGINES.builtin else []
    return shlex.join(words)


def _shards(made: Manifest, split: str) -> list[str]:
    """Patterns of the names of a split's shards."""
    return [*dict.fromkeys(pattern_of(one.file) for one in made.shards if one.split == split)]


def _notes(made: Manifest) -> dict[str, str]:
    """Sentences that differ between datasets of several sorts."""
    rejected = [
        f"{what}: {', '.join(f'{reason} {count}' for reason, count in reasons.items())}"
        for what, reasons in made.rejected.items()
        if reasons
    ]
    notes = {
        "surfaces": "",
        "surface": "",
        "derived": "",
        "faults": "without noise or motion, and with every return within range",
        "caster": "MuJoCo" if made.engine == MUJOCO else f"the engine {made.engine}",
        "drawn": "Random worlds are drawn from",
        "people": "Worlds are synthetic and simple: they are of no real place, and hold neither "
        "people nor personal data.",
        "biases": f"Worlds follow the distributions of {NAME} and no "
        "real place; the frequencies of shapes, gaps and densities are those of the recipe.",
        "follows": f"every sample follows from the seed and the recipe in `{NAME}`",
        "rejected": f"Rejected while drawing: {'; '.join(rejected) or 'none'}.",
    }
    if made.grid.hollow:
        notes["surfaces"] = (
            " Truth is of surfaces: a voxel that lies wholly inside one solid is not occupied."
        )
        notes["surface"] = "the surface of "
    if absent := " and ".join(f"`{name}`" for name in ("free", "tudf") if name not in made.fields):
        notes["derived"] = f" {absent} follow from these; scenegen derives them on reading."
    if made.noise is not None:
        notes["faults"] = f"with simulated noise, `{made.noise.stages}`"
    if made.kind == "scene":
        notes |= {
            "drawn": "Worlds were given as files; from",
            "people": "Worlds were given as files; whether these show real places or people, only "
            "their publisher can say.",
            "biases": "Worlds are few, and those that their author thought of.",
        }
    if made.like is not None:
        notes |= {
            "follows": "the worlds and poses of another dataset were scanned again by the sensor "
            f"that `{NAME}` names",
            "rejected": f"The worlds and poses are those of the dataset {made.like}, scanned "
            "again.",
        }
    return notes


def _template(name: str) -> str:
    return (files("scenegen.publish") / name).read_text(encoding="utf-8")


def card(given: Json) -> str:
    """The card of a dataset of which `facts` are given."""
    text = _template("card.md")
    # four ends of lines where there are no pictures
    return Template(text).substitute(given).replace("\n\n\n\n", "\n\n")


def _table(*rows: Sequence[str]) -> str:
    """A table in Markdown; the first row is its head."""
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([lines[0], "|---" * len(rows[0]) + "|", *lines[1:]])


def stored(made: Manifest) -> dict[str, Json]:
    """What the shards store, in order: name to `dtype`, `shape`, `unit` and `meaning`."""
    described = made.schema.describe()
    known = {name: described[name] for name in made.fields}
    digest = {"meaning": "the sample's own SHA-256 digest", "unit": ""}
    return known | {DIGEST: {"dtype": "uint8", "shape": (32,), **digest}}


def _fields(made: Manifest) -> str:
    rows = [["field", "type, shape of a sample", "unit", "meaning"]]
    for name, field in stored(made).items():
        shape = " × ".join(map(str, field["shape"]))
        kind = f"{field['dtype']} ({shape})" if shape else field["dtype"]
        rows.append([f"`{name}`", kind, field["unit"] or "–", field["meaning"]])
    table = _table(*rows)
    if "labels" in made.parts:
        classes = made.parts["labels"].classes
        more = f" and {len(classes) - MOST_NAMED} more" if len(classes) > MOST_NAMED else ""
        table += f"\n\nClasses, from 0: {', '.join(map(json.dumps, classes[:MOST_NAMED]))}{more}."
    return table


def _statistics(splits: Json) -> str:
    rows = [["", *splits]]
    for name, key in (("samples", "samples"), ("worlds", "worlds"), ("measured", "sampled")):
        rows.append([name, *(str(split[key]) for split in splits.values())])
    for key, (label, unit) in TITLES.items():
        factor = 100 if unit == "%" else 1
        row = [f"{label}, {unit}".removesuffix(", ")]
        for split in splits.values():
            mean, std = (split["statistics"][key][name] for name in ("mean", "std"))
            row.append("–" if mean is None else f"{mean * factor:.2f} ± {std * factor:.2f}")
        rows.append(row)
    return _table(*rows)


def croissant(given: Json, made: Manifest, told: Json, sums: Mapping[str, str]) -> str:
    """The file of a dataset of which `facts` are given; `sums` has the SHA-256 of the
    files that have entries of their own, by name."""
    inside = {key: json.dumps(str(value), ensure_ascii=False)[1:-1] for key, value in given.items()}
    found = json.loads(Template(_template("croissant.json")).substitute(inside))
    url, tag = given["url"], given["tag"]
    files = [
        _node(
            "FileObject",
            "repository",
            description="The repository on the Hub; in place of a checksum, the dataset's digest.",
            contentUrl=f"{url}/tree/{tag}",
            encodingFormat="git+https",
            sha256=made.digest,
        )
    ]
    files += [
        _node(
            "FileObject",
            name,
            encodingFormat=FORMATS[name.rpartition(".")[2]],
            contentUrl=f"{url}/resolve/{tag}/{name}",
            sha256=digest,
        )
        for name, digest in sums.items()
    ]
    sets = []
    for split, counted in told["splits"].items():
        said = f"samples of the {split} split"
        files.append(
            _node(
                "FileSet",
                f"{split}-shards",
                description=f"HDF5 files; {said} along the first dimension of every dataset.",
                containedIn={"@id": "repository"},
                includes=_shards(made, split),
                encodingFormat=FORMATS["h5"],
            )
        )
        sets.append(
            _node(
                "RecordSet",
                split,
                description=f"{counted['samples']} {said}.",
                key=[{"@id": f"{split}/{DIGEST}"}],
                field=[_field(split, name, meta) for name, meta in stored(made).items()],
            )
        )
    found |= {"distribution": files, "recordSet": sets}
    return json.dumps(found, indent=1, ensure_ascii=False) + "\n"


def _node(kind: str, name: str, **about: Any) -> Json:
    """A thing of the file, which others call by its name."""
    return {"@type": f"cr:{kind}", "@id": name, "name": name, **about}


def _field(split: str, name: str, meta: Json) -> Json:
    """A field of a split's samples; its column is the name of its HDF5 dataset."""
    kind = meta["dtype"]
    found = {
        "@type": "cr:Field",
        "@id": f"{split}/{name}",
        "name": name,
        "description": meta["meaning"] + (f", in {meta['unit']}" if meta["unit"] else ""),
        "dataType": "sc:Boolean"
        if kind == "bool"
        else f"cr:{kind.capitalize().replace('Ui', 'UI')}",
        "source": {"fileSet": {"@id": f"{split}-shards"}, "extract": {"column": name}},
    }
    if meta["shape"]:
        found |= {"isArray": True, "arrayShape": ",".join(map(str, meta["shape"]))}
    return found
