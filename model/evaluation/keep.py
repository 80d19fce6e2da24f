"""What a bench found on one dataset, kept in a file, so that a long study measures each network
once."""

import dataclasses
import io
import json
import zipfile
import zlib
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim import GridSpec
from scenegen.errors import DatasetError
from scenegen.files import read_bounded, write_whole
from scenegen.model.config import Thresholds
from scenegen.model.evaluation.config import BenchConfig
from scenegen.model.evaluation.planning.measure import Measurement
from scenegen.model.evaluation.run import DatasetResult, MethodResult
from scenegen.model.evaluation.study.maps import Study
from scenegen.model.evaluation.study.planning import Setting

MOST_BYTES = 1 << 30
TREE, ARRAY = "tree", "array"
"""The member of the archive that is JSON; in it, how an array is named that is another member."""


def keep(path: Path, result: DatasetResult, stamp: Mapping[str, Any]) -> None:
    """Write `result` to the NumPy archive `path`; `stamp`, JSON, says what it was measured on.
    Raises DatasetError where the disk refuses."""
    arrays: dict[str, np.ndarray] = {}
    fields = {field.name: getattr(result, field.name) for field in dataclasses.fields(result)}
    tree = {"stamp": stamp, "result": _packed({**fields, "config": None}, arrays)}
    memory = io.BytesIO()
    np.savez_compressed(memory, **{TREE: np.array(json.dumps(tree))}, **arrays)  # type: ignore[arg-type]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, memory.getvalue())


def kept(path: Path, config: BenchConfig, stamp: Mapping[str, Any]) -> DatasetResult | None:
    """The result, of `config`, that `keep` wrote to `path` with `stamp`; None where there is none,
    or another, or it is damaged."""
    try:
        with np.load(io.BytesIO(read_bounded(path, MOST_BYTES)), allow_pickle=False) as archive:
            tree = json.loads(str(archive[TREE]))
            if tree["stamp"] != json.loads(json.dumps(stamp)):
                return None
            held = _unpacked(tree["result"], archive)
        return DatasetResult(
            **held
            | {
                "grid": GridSpec(**held["grid"]),
                "config": config,
                "excluded": Counter(held["excluded"]),
                "trial_places": tuple((sample, turn) for sample, turn in held["trial_places"]),
                "methods": {name: _method(method) for name, method in held["methods"].items()},
            }
        )
    except (
        OSError,
        DatasetError,
        ValueError,
        KeyError,
        TypeError,
        EOFError,
        zipfile.BadZipFile,
        zlib.error,
    ):
        return None


def _method(held: dict[str, Any]) -> MethodResult:
    study = held["study"]
    if study is not None:
        settings = tuple(Setting(**setting) for setting in study["settings"])
        study = Study(**study | {"risks": tuple(study["risks"]), "settings": settings})
    trials = tuple(Measurement(**trial) for trial in held["trials"])
    return MethodResult(
        **held | {"thresholds": Thresholds(**held["thresholds"]), "trials": trials, "study": study}
    )


def _packed(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """`value` as JSON; its arrays are put into `arrays`, and named."""
    if isinstance(value, np.ndarray):
        name = f"{ARRAY}{len(arrays)}"
        arrays[name] = value
        return {ARRAY: name}
    if dataclasses.is_dataclass(value):
        return {
            field.name: _packed(getattr(value, field.name), arrays)
            for field in dataclasses.fields(value)
        }
    if isinstance(value, Mapping):
        return {name: _packed(one, arrays) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_packed(one, arrays) for one in value]
    return value


def _unpacked(value: Any, archive: Mapping[str, np.ndarray]) -> Any:
    if isinstance(value, list):
        return [_unpacked(one, archive) for one in value]
    if not isinstance(value, dict):
        return value
    if value.keys() == {ARRAY}:
        return archive[value[ARRAY]]
    return {name: _unpacked(one, archive) for name, one in value.items()}
