"""`croissant.json`: the dataset in MLCommons' Croissant 1.1, with its responsible-AI extension."""

import json
from collections.abc import Mapping
from typing import Any

from lidarsim.engines import MUJOCO
from scenegen.dataset.manifest import VERSION
from scenegen.share.publication import PAPER, Publication
from scenegen.share.regenerate import RECIPE

CROISSANT = "http://mlcommons.org/croissant/1.1"
RESPONSIBLE = "http://mlcommons.org/croissant/RAI/1.0"
FORMATS = {
    ".h5": "application/x-hdf5",
    ".zip": "application/zip",
    ".json": "application/json",
    ".npy": "application/octet-stream",
}
TYPES = {
    "bool": "sc:Boolean",
    "uint8": "cr:UInt8",
    "uint16": "cr:UInt16",
    "int32": "cr:Int32",
    "int64": "cr:Int64",
    "float32": "cr:Float32",
    "float64": "cr:Float64",
}
"""Types of fields, by numpy's names."""
TERMS = """
arrayShape citeAs column containedIn equivalentProperty extract field fileObject fileProperty
fileSet format includes isArray isLiveDataset jsonPath key md5 parentField path recordSet references
regex repeated replace samplingRate separator source subField transform
"""
"""Terms of Croissant that keep their names."""
CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "dct": "http://purl.org/dc/terms/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "sc": "https://schema.org/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "description": {"@container": "@language"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "name": {"@container": "@language"},
} | {term: f"cr:{term}" for term in TERMS.split()}
"""What the short names mean, as the specification has it."""


def croissant(it: Publication, sha256: Mapping[str, str]) -> str:
    """The file; `sha256` gives the digest of every shard, archive and manifest by name."""
    owner = it.repository.partition("/")[0]
    found = {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "name": it.name,
        "description": f"{it.sentence}.",
        "conformsTo": [CROISSANT, RESPONSIBLE],
        "license": it.licence.url,
        "url": it.url,
        "version": f"{VERSION}.{it.manifest.tables.get('version', 0)}.0",
        "datePublished": it.date,
        "creator": {
            "@type": "sc:Organization",
            "name": owner,
            "url": f"https://huggingface.co/{owner}",
        },
        "citeAs": f"{owner}: {it.name}, revision {it.tag}, {it.url}. After {PAPER}.",
        "keywords": ["3D scene completion", "occupancy", "distance field", "LiDAR", "synthetic"],
        "isLiveDataset": False,
        **_responsible(it),
        "distribution": _distribution(it, sha256),
        "recordSet": [_record_set(it, split) for split in it.splits],
    }
    return json.dumps(found, indent=1, ensure_ascii=False) + "\n"


def _responsible(it: Publication) -> dict[str, Any]:
    """How the data came about, what they are for, and what they are not."""
    engine, by_hand = it.manifest.engine, it.manifest.kind == "scene"
    worlds = "Worlds were given as MJCF files; from" if by_hand else "Random worlds are drawn from"
    count = sum(sum(counts.values()) for counts in it.manifest.rejected.values())
    rejected = f"{count} worlds and viewpoints with too little to see were drawn again."
    if it.manifest.rescan is not None:
        original = it.manifest.rescan["digest"]
        rejected = f"The worlds and poses are those of the dataset {original}, scanned again."
    made = ", ".join(f"{name} {number}" for name, number in it.manifest.software.items())
    recipe = RECIPE if it.manifest.rescan is None else "the recipe in dataset.json"
    noise = it.manifest.noise
    faults = (
        "a scan without noise or motion"
        if noise is None
        else f"simulated noise ({noise['stages']})"
    )
    return {
        "rai:dataCollection": (
            f"Simulated. {worlds} seed {it.manifest.seed}, a planner flies a robot through "
            f"each, and a LiDAR of {it.manifest.lidar} is cast from its poses by "
            f"{'MuJoCo' if engine == MUJOCO else f'the engine {engine}'}. "
            "Nothing was recorded in the real world."
        ),
        "rai:dataCollectionType": ["Software Collection"],
        "rai:dataCollectionRawData": "The MJCF model of every world, in the archives beside the "
        "shards.",
        "rai:dataCollectionMissingData": (
            "Rays without a return within the sensor's reach are stored as infinity; voxels that "
            "no ray met are "
            f"neither observed nor free. {rejected}"
        ),
        "rai:dataPreprocessingProtocol": [
            "Returns are sorted into voxels; voxels that rays cross are marked free.",
            "Distances are an exact Euclidean transform of occupancy, truncated.",
        ],
        "rai:dataAnnotationProtocol": [
            "Truth is computed, not labelled: a voxel is occupied where its closed cube touches "
            f"{'the surface of ' if it.manifest.grid.hollow else ''}a solid of the world, decided "
            f"by closed forms."
        ],
        "rai:machineAnnotationTools": [made],
        "rai:dataUseCases": [
            "Training and comparing networks that complete a partial 3D map, and planning in "
            "completed maps.",
            "Not for certifying the safety of a robot.",
        ],
        "rai:dataBiases": [
            "Worlds are few, and those that their author thought of."
            if by_hand
            else f"Worlds follow the distributions of {recipe} and no real place; the frequencies "
            f"of shapes, gaps "
            "and densities are those of the recipe."
        ],
        "rai:dataLimitations": [
            f"Rigid and static solids, {faults}, one sensor and one voxel size.",
            "Maps end at their faces: distances do not know what lies outside.",
        ],
        "rai:dataSocialImpact": "Reproducible data for research on navigation, at the price of "
        "minutes of computing.",
        "rai:personalSensitiveInformation": [
            "None: there are no people, places or personal data in it."
        ],
        "rai:dataReleaseMaintenancePlan": (
            f"Revision {it.tag} stays as it is; a correction gets a tag of its own. Digest "
            f"{it.manifest.digest}."
        ),
    }


def _node(kind: str, name: str, **about: Any) -> dict[str, Any]:
    """A thing of the file, which others call by its name."""
    return {"@type": f"cr:{kind}", "@id": name, "name": name, **about}


def _distribution(it: Publication, sha256: Mapping[str, str]) -> list[dict[str, Any]]:
    """The repository, each of its data files, and the shards of each split as a set."""
    said = "The repository on the Hub; in place of a checksum, the dataset's own digest."
    at = {
        "contentUrl": f"{it.url}/tree/{it.tag}",
        "encodingFormat": "git+https",
        "sha256": it.manifest.digest,
    }
    found = [_node("FileObject", "repository", description=said, **at)]
    for name, digest in sha256.items():
        url, form = f"{it.url}/resolve/{it.tag}/{name}", FORMATS[name[name.rindex(".") :]]
        found.append(_node("FileObject", name, contentUrl=url, encodingFormat=form, sha256=digest))
    for split in it.splits:
        said = (
            f"HDF5 files of the {split} split; samples along the first dimension of every dataset."
        )
        within = {
            "containedIn": {"@id": "repository"},
            "encodingFormat": FORMATS[".h5"],
            "includes": f"{split}-*.h5",
        }
        found.append(_node("FileSet", f"{split}-shards", description=said, **within))
    return found


def _record_set(it: Publication, split: str) -> dict[str, Any]:
    """The samples of a split; a field's column is the name of its HDF5 dataset."""
    fields = []
    for name, meta in it.fields.items():
        field = {
            "@type": "cr:Field",
            "@id": f"{split}/{name}",
            "name": name,
            "description": meta["meaning"] + (f", in {meta['unit']}" if meta["unit"] else ""),
            "dataType": TYPES[meta["dtype"]],
            "source": {"fileSet": {"@id": f"{split}-shards"}, "extract": {"column": name}},
        }
        if meta["shape"]:
            field |= {"isArray": True, "arrayShape": ",".join(map(str, meta["shape"]))}
        fields.append(field)
    said = f"{it.statistics['splits'][split]['samples']} samples of the {split} split."
    key = [{"@id": f"{split}/world"}, {"@id": f"{split}/viewpoint"}]
    return _node("RecordSet", split, description=said, key=key, field=fields)
