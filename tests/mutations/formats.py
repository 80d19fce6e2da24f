"""Formats as data: the files of each, what damages them, what reads them, and how that may end."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from tests.mutations import damage_hdf5, damage_options
from tests.mutations.case import REFUSED, SAME, Attempt, refuses, words
from tests.mutations.dataset_commands import read_dataset
from tests.mutations.datasets import sign
from tests.mutations.mutators import (
    in_bytes,
    in_document,
    in_header,
    in_numbers,
    in_predictions,
    in_sections,
    in_toml,
    in_words,
)
from tests.mutations.valid import BENCH, EDGE, INGEST, scores


@dataclass(frozen=True, kw_only=True)
class Format:
    """Files that commands read."""

    files: str
    """A pattern, in the folder of valid files."""
    mutators: tuple[Callable[..., Any], ...]
    commands: tuple[str, ...]
    makes: str
    """What the commands may make, beside nothing else."""
    beside: str = ""
    """What else they read."""
    after: Callable[[], Any] | None = None
    """See `Attempt`."""
    holds: Callable[..., str] = lambda result: ""

    def attempt(self, random, valid, here):
        """A file of this format, damaged, and a command that reads it."""
        name = random.choice(sorted(path.name for path in valid.folder.glob(self.files)))
        for other in {*words(self.beside)} - {name}:
            valid.put(other, here)
        os.mkfifo(here / "pipe")
        path = valid.put(name, here)
        if path.is_dir():
            path = random.choice([one for one in sorted(path.rglob("*")) if one.is_file()])
        said, expected = random.choice(self.mutators)(path, random)
        holds = self.holds
        if expected == REFUSED:
            holds = refuses(said)
        elif expected == SAME:
            holds = partial(_same_scores, valid.scored)
        return Attempt(
            words=words(random.choice(self.commands).format(name)),
            damage=f"{path.relative_to(here)}: {ascii(said)[:150]}",
            makes=words(self.makes),
            after=self.after,
            holds=holds,
        )


def _same_scores(scored, result):
    same = scores(result.folder / "bench") == scored
    return "" if same else "other scores than without the damage"


def _examine():
    """What the dataset in ``out`` holds, and what `verify` says of it; in a process that may have
    crashed by it."""
    from scenegen.verification import verify

    wrong = [outcome.detail for outcome in verify(Path("out"), quick=True).checks if not outcome.ok]
    for path in Path("out").glob("*.h5"):
        with h5py.File(path) as file:
            numbers = [file[name][()].ravel() for name in ("position", "quaternion", "origin")]
            if np.isnan(file["ranges"][()]).any() or not np.isfinite(np.concatenate(numbers)).all():
                wrong.append(f"{path} holds numbers that are none")
    return wrong


def _nothing_wrong(result):
    return f"wrote what cannot be: {result.after[:3]}" if result.after else ""


def _completed():
    """Whether numbers of the completion in ``out.h5`` cannot be such; no NaN can."""
    with h5py.File("out.h5", "r") as file:
        return [
            name
            for name, maximum in (("occupancy_probability", 1.0), ("tudf", 2.0))
            if name in file
            and not (
                file[name].shape == (EDGE,) * 3
                and (abs(file[name][()] - maximum / 2) <= maximum / 2).all()
            )
        ]


def _mapped():
    """Maps in ``out`` that are of nothing."""
    from scenegen.worlds.place import read_place

    maps = [read_place(path).voxels.states for path in sorted(Path("out").glob("place*"))]
    return [] if maps and all(states.size for states in maps) else ["a map of nothing"]


def _dataset(mutator, endings):
    """Attempts on a file of a dataset, damaged; mostly signed again, so that its digest in the
    manifest holds."""

    def attempt(random, valid, here):
        name = random.choice("ddc")
        folder = valid.put(name, here)
        path = random.choice(sorted(folder.glob(f"*{random.choice(endings)}")))
        said, expected = mutator(path, random)
        if path.suffix != ".json" and random.random() < 0.6:
            sign(folder)
            said += ", signed again"
        expected = expected if path.suffix == ".h5" else SAME
        return read_dataset(random, valid, here, name, f"{name}/{path.name}: {said}", expected)

    return attempt


def _generated(asked):
    return f"generate {asked} --n 1 --val 0 --test 0 --out out --workers 1 --quiet"


GENERATED = {"makes": "out out/*", "after": _examine, "holds": _nothing_wrong}
COMPLETED = {"makes": "out.h5", "after": _completed, "holds": _nothing_wrong}
COMPLETE = "complete {} --weights {} --quiet --device cpu -o out.h5"
SCAN = "scan {} --pose 0.2,0.2,0.2,0 --quiet -o a.ply"
OF_SCENE = "--scene {} --recipe scene.toml"
IN_FILES = {"mutators": (in_bytes, in_words)}
RECIPES = Format(
    files="recipe.toml", mutators=(in_toml,), commands=(_generated("--recipe {}"),), **GENERATED
)
SCENES = Format(
    files="scene.xml",
    beside="scene.toml",
    mutators=(*[in_numbers, in_sections] * 4, in_document, in_bytes),
    commands=(*[_generated(OF_SCENE)] * 2, _generated(f"{OF_SCENE} --allow-unseen")),
    **GENERATED,
)
WEIGHTS = Format(
    files="n.*",
    beside="scan.npy",
    mutators=(in_header, in_header, in_header, in_bytes),
    commands=(COMPLETE.format("scan.npy", "{}"),),
    **COMPLETED,
)
PREDICTIONS = Format(
    files="predictions.h5",
    beside="d",
    mutators=(in_bytes, *[in_predictions] * 4),
    commands=(BENCH,),
    makes="bench bench/*",
)
SCANS = Format(
    files="scan.*",
    beside="n.safetensors",
    commands=(COMPLETE.format("{}", "n.safetensors"),),
    **IN_FILES,
    **COMPLETED,
)
MAPS = Format(files="map.*", commands=("inspect {} --json", SCAN), makes="a.ply", **IN_FILES)
PLANS = Format(
    files="plan.*",
    beside="plan.yaml plan.pgm",
    commands=("map plan.yaml --quiet -o a.npz", SCAN.format("plan.yaml")),
    makes="a.npz a.ply",
    **IN_FILES,
)
LOGS = Format(
    files="log.*",
    commands=("ingest {} " + INGEST,),
    makes="out out/* out.part*",
    after=_mapped,
    holds=_nothing_wrong,
    **IN_FILES,
)


def _files(random, valid, here):
    return random.choice((SCANS, MAPS, PLANS, LOGS)).attempt(random, valid, here)


FAMILIES = {
    "bytes": _dataset(in_bytes, (*[".h5"] * 3, ".zip", ".json")),
    "hdf5": _dataset(damage_hdf5.in_shard, [".h5"]),
    "recipes": RECIPES.attempt,
    "scenes": SCENES.attempt,
    "weights": WEIGHTS.attempt,
    "predictions": PREDICTIONS.attempt,
    "files": _files,
    "options": damage_options.attempt,
}
"""By name, a function of chance, the valid files and an empty folder, which gives an `Attempt`."""
