"""The description of a published dataset: for people the card, `README.md`; for machines
`croissant.json`, in MLCommons' Croissant 1.1 with its responsible-AI extension. Their templates are
`card.md` and `croissant.json` beside this file. The parts that differ between datasets are made
here.
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
from scenegen.view.inspect import titles

MAX_LISTED = 50
"""Maximum names of classes in a card."""
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
    "parking": "multi-storey car parks with ramps, cars, walls and gates",
    "orchard": "orchards with trees on trellises, wires and blocked aisles",
    "scaffold": "façades in tube scaffolding with planks, nets and rooms behind",
    "rubble": "collapsed buildings with leaning slabs, broken columns and heaps",
    "scene": "worlds given as files",
}
FORMATS = {
    "h5": "application/x-hdf5",
    "zip": "application/zip",
    "json": "application/json",
    "npy": "application/octet-stream",
}


def facts(
    manifest: Manifest,
    summary: Json,
    repository: str,
    licence: str,
    *,
    tag: str,
    date: str,
    checks: Sequence[tuple[str, str]],
    pictures: str,
) -> Json:
    """Return the values of all placeholders of `card.md` and `croissant.json`, by name.

    Args:
        manifest: The dataset's manifest.
        summary: The dataset's summary, see `scenegen.view.inspect.inspect`.
        repository: The repository on the Hub, user/name.
        licence: SPDX name of the licence.
        tag: Revision of this content on the Hub.
        date: Day of publication, YYYY-MM-DD.
        checks: Name and detail of every check that the dataset passed.
        pictures: Markdown that shows its pictures.
    """
    owner, _, name = repository.partition("/")
    licence_name, licence_url = LICENCES[licence]
    splits = summary["splits"]
    maps = "" if manifest.mapping.plain else f", each {manifest.mapping}"
    worlds = KINDS.get(manifest.kind, f"worlds of kind {manifest.kind}")
    voxels = (
        f"{' × '.join(map(str, manifest.grid.shape))} voxel maps of {manifest.grid.voxel_m:g} m"
    )
    return {
        **_notes(manifest),
        "name": name,
        "owner": owner,
        "repository": repository,
        "url": f"https://huggingface.co/datasets/{repository}",
        "tag": tag,
        "date": date,
        "year": date[:4],
        # the Hub names these licences without their version
        "hub_licence": re.sub(r"(od.+|pddl)-1\.0", r"\1", licence.lower()),
        "licence": licence_name,
        "licence_url": licence_url,
        "paper": PAPER,
        "sentence": f"{summary['samples']} pairs of a simulated LiDAR scan and the exact truth "
        f"around it, in {worlds}, as {voxels}{maps}",
        # three numbers, as Croissant asks for MAJOR.MINOR.PATCH
        "version": f"{VERSION}.{manifest.tables.version}.0",
        "seed": manifest.seed,
        "lidar": str(manifest.lidar),
        "digest": manifest.digest,
        "centred": "" if maps else " and the sensor sits at the map's centre",
        "versions": ", ".join(f"{name} {number}" for name, number in manifest.software.items()),
        "voxel_m": manifest.grid.voxel_m,
        "truncation_m": f"{manifest.grid.truncation_m:g}",
        "command": command(manifest, repository, tag),
        "samples": summary["samples"],
        "split": next(iter(splits)),
        "data_files": "\n".join(
            # a list in JSON is one in YAML, too
            f"  - split: {split}\n    path: {json.dumps(_shards(manifest, split))}"
            for split in splits
        ),
        "pictures": pictures,
        "fields": _fields(manifest),
        "statistics": _statistics(splits),
        "megabytes": f"{summary['bytes'] / 1e6:.1f}",
        "kilobytes": f"{summary['bytes_per_sample'] / 1e3:.1f}",
        "checks": "\n".join(f"- {check}: {detail}" for check, detail in checks),
    }


def command(manifest: Manifest, repository: str, tag: str) -> str:
    """Return the command line that makes a dataset again.

    Args:
        manifest: The dataset's manifest.
        repository: The repository on the Hub, user/name.
        tag: Revision of this content on the Hub.

    Returns:
        A command that needs only the manifest if a recipe drew the worlds; else the published
        dataset, which has them.
    """
    drawn = manifest.kind != "scene" and manifest.like is None
    like = NAME if drawn else f"hf://{repository}@{tag}"
    words = ["scenegen", "generate", "--like", like, "--out", repository.rpartition("/")[2]]
    # a user's own modules are imported only if the command names them
    words += ["--kind", manifest.kind] if ":" in manifest.kind else []
    words += ["--engine", manifest.engine] if manifest.engine not in ENGINES.builtin else []
    return shlex.join(words)


def _shards(manifest: Manifest, split: str) -> list[str]:
    """Return patterns that match the names of a split's shards."""
    return [
        *dict.fromkeys(pattern_of(shard.file) for shard in manifest.shards if shard.split == split)
    ]


def _notes(manifest: Manifest) -> dict[str, str]:
    """Return sentences that depend on how a dataset was made, by the name of their placeholder."""
    rejected = [
        f"{subject}: {', '.join(f'{reason} {count}' for reason, count in reasons.items())}"
        for subject, reasons in manifest.rejected.items()
        if reasons
    ]
    notes = {
        "surfaces": "",
        "surface": "",
        "derived": "",
        "faults": "without noise or motion, and with every return within range",
        "caster": "MuJoCo" if manifest.engine == MUJOCO else f"the engine {manifest.engine}",
        "drawn": "Random worlds are drawn from",
        "people": "Worlds are synthetic and simple: they are of no real place, and hold neither "
        "people nor personal data.",
        "biases": f"Worlds follow the distributions of {NAME} and no "
        "real place; the frequencies of shapes, gaps and densities are those of the recipe.",
        "follows": f"every sample follows from the seed and the recipe in `{NAME}`",
        "rejected": f"Rejected while drawing: {'; '.join(rejected) or 'none'}.",
    }
    if manifest.grid.hollow:
        notes["surfaces"] = (
            " Truth is of surfaces: a voxel that lies wholly inside one solid is not occupied."
        )
        notes["surface"] = "the surface of "
    # compact datasets lack fields that follow from the others
    if absent := " and ".join(
        f"`{name}`" for name in ("free", "tudf") if name not in manifest.fields
    ):
        notes["derived"] = f" {absent} follow from these; scenegen derives them on reading."
    if manifest.noise is not None:
        notes["faults"] = f"with simulated noise, `{manifest.noise.stages}`"
    if manifest.kind == "scene":
        notes |= {
            "drawn": "Worlds were given as files; from",
            "people": "Worlds were given as files; whether these show real places or people, only "
            "their publisher can say.",
            "biases": "Worlds are few, and those that their author thought of.",
        }
    if manifest.like is not None:
        notes |= {
            "follows": "the worlds and poses of another dataset were scanned again by the sensor "
            f"that `{NAME}` names",
            "rejected": f"The worlds and poses are those of the dataset {manifest.like}, scanned "
            "again.",
        }
    return notes


def _template(name: str) -> str:
    return (files("scenegen.publish") / name).read_text(encoding="utf-8")


def card(values: Json) -> str:
    """Return the card of a dataset; `values` are from `facts`."""
    text = _template("card.md")
    # without pictures, their paragraph leaves empty lines
    return Template(text).substitute(values).replace("\n\n\n\n", "\n\n")


def _table(*rows: Sequence[str]) -> str:
    """Return a table in Markdown; the first row is its head."""
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([lines[0], "|---" * len(rows[0]) + "|", *lines[1:]])


def stored(manifest: Manifest) -> dict[str, Json]:
    """Return the fields of shards in order: `dtype`, `shape`, `unit` and `meaning` by name."""
    described = manifest.schema.describe()
    known = {name: described[name] for name in manifest.fields}
    digest = {"meaning": "the sample's own SHA-256 digest", "unit": ""}
    return known | {DIGEST: {"dtype": "uint8", "shape": (32,), **digest}}


def _fields(manifest: Manifest) -> str:
    """Return the card's table of fields."""
    rows = [["field", "type, shape of a sample", "unit", "meaning"]]
    for name, field in stored(manifest).items():
        shape = " × ".join(map(str, field["shape"]))
        kind = f"{field['dtype']} ({shape})" if shape else field["dtype"]
        rows.append([f"`{name}`", kind, field["unit"] or "–", field["meaning"]])
    table = _table(*rows)
    if "labels" in manifest.parts:
        classes = manifest.parts["labels"].classes
        suffix = f" and {len(classes) - MAX_LISTED} more" if len(classes) > MAX_LISTED else ""
        table += f"\n\nClasses, from 0: {', '.join(map(json.dumps, classes[:MAX_LISTED]))}{suffix}."
    return table


def _statistics(splits: Json) -> str:
    """Return the card's table of measures, by split."""
    rows = [["", *splits]]
    for name, key in (("samples", "samples"), ("worlds", "worlds"), ("measured", "sampled")):
        rows.append([name, *(str(split[key]) for split in splits.values())])
    for key, (label, unit) in titles(splits).items():
        factor = 100 if unit == "%" else 1
        row = [f"{label}, {unit}".removesuffix(", ")]
        for split in splits.values():
            mean, std = (split["statistics"][key][name] for name in ("mean", "std"))
            row.append("–" if mean is None else f"{mean * factor:.2f} ± {std * factor:.2f}")
        rows.append(row)
    return _table(*rows)


def croissant(values: Json, manifest: Manifest, summary: Json, sums: Mapping[str, str]) -> str:
    """Return the content of `croissant.json`.

    Args:
        values: Values of placeholders, from `facts`.
        manifest: The dataset's manifest.
        summary: The dataset's summary, see `scenegen.view.inspect.inspect`.
        sums: SHA-256 of each file that gets an entry, by its name.
    """
    # values stand within JSON strings of the template: quotes and line ends must be escaped
    inside = {
        key: json.dumps(str(value), ensure_ascii=False)[1:-1] for key, value in values.items()
    }
    document = json.loads(Template(_template("croissant.json")).substitute(inside))
    url, tag = values["url"], values["tag"]
    # Croissant: files hold records, whose fields name their source
    files = [
        _node(
            "FileObject",
            "repository",
            description="The repository on the Hub; in place of a checksum, the dataset's digest.",
            contentUrl=f"{url}/tree/{tag}",
            encodingFormat="git+https",
            # Croissant demands a checksum of every file, and a repository has none
            sha256=manifest.digest,
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
    for split, counted in summary["splits"].items():
        subject = f"samples of the {split} split"
        files.append(
            _node(
                "FileSet",
                f"{split}-shards",
                description=f"HDF5 files; {subject} along the first dimension of every dataset.",
                containedIn={"@id": "repository"},
                includes=_shards(manifest, split),
                encodingFormat=FORMATS["h5"],
            )
        )
        sets.append(
            _node(
                "RecordSet",
                split,
                description=f"{counted['samples']} {subject}.",
                key=[{"@id": f"{split}/{DIGEST}"}],
                field=[_field(split, name, meta) for name, meta in stored(manifest).items()],
            )
        )
    document |= {"distribution": files, "recordSet": sets}
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"


def _node(kind: str, name: str, **properties: Any) -> Json:
    """Return a node of the file, which other nodes refer to by its name."""
    return {"@type": f"cr:{kind}", "@id": name, "name": name, **properties}


def _field(split: str, name: str, meta: Json) -> Json:
    """Return a field of a split's samples; its column is the name of its HDF5 dataset."""
    # Croissant's own names of types: cr:UInt8, cr:Float32
    kind = meta["dtype"]
    node = {
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
        node |= {"isArray": True, "arrayShape": ",".join(map(str, meta["shape"]))}
    return node
