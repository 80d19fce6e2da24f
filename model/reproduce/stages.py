"""From a seed to the study's report, stage by stage: what is there is kept, what is damaged is made again."""

import hashlib
import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from scenegen.checkout import commit
from scenegen.dataset.build import build, plan_dataset
from scenegen.dataset.manifest import differences
from scenegen.dataset.read import Dataset
from scenegen.errors import DatasetError, printable
from scenegen.files import disk_error, read_bounded, write_whole
from scenegen.limits import MOST_MANIFEST_BYTES
from scenegen.model.checkpoint import CheckpointError, load_network
from scenegen.model.completion.unlearned import Extrude, Returns
from scenegen.model.evaluation.config import BenchConfig
from scenegen.model.evaluation.methods import Completed, Method, Truth
from scenegen.model.evaluation.pretrained import Pretrained
from scenegen.model.evaluation.report import build_report
from scenegen.model.evaluation.run import bench
from scenegen.model.evaluation.seen import Seen
from scenegen.model.reproduce.claims import answers, judged
from scenegen.model.reproduce.config import ReproduceConfig
from scenegen.model.reproduce.report import to_markdown
from scenegen.model.reproduce.runs import RUNS, SEEDS, Run
from scenegen.model.training.data import opened
from scenegen.model.training.device import choose_device, device_name
from scenegen.model.training.loop import Watcher, train
from scenegen.model.training.run_folder import BEST, CONFIG
from scenegen.recipe import preset
from scenegen.source import DrawnWorlds
from scenegen.workers import run as run_workers

if TYPE_CHECKING:
    from scenegen.terminal.progress import Progress

KINDS = ("geometric", "pillar")
SETTINGS, STUDY, TEXT = "settings.json", "study.json", "study.md"
TRIALS = 2000
"""Planning trials a kind at scale 1 (the paper's)."""


def reproduce(
    out: Path,
    config: ReproduceConfig,
    *,
    device: str = "auto",
    workers: int = 1,
    progress: Callable[[str], "Progress"],
) -> dict[str, Any]:
    """Make the study of `config` in the folder `out`, or go on with it, and return what ``study.json`` holds.

    On a CPU, `workers` networks are trained side by side, one thread each; on a GPU, one after the other. Raises
    DatasetError for a folder that holds another study, and what its stages raise.
    """
    chosen = runs(config)
    begin(out, config)
    folders = [_dataset(out / "data" / kind, kind, config, workers, progress(kind)) for kind in KINDS]
    where = choose_device(device)
    with progress("networks") as shown:
        shown.start(sum(run.config(config.scaled(config.maps)).maps or 0 for run in chosen))
        work = partial(_train, out, folders, config, str(where), shown if workers == 1 else None)
        side_by_side = 1 if where.type == "cuda" else workers
        for maps in run_workers(work, chosen, side_by_side, lambda: None):
            shown.count(maps)
    measured = [_measure(out, folder, chosen, config, workers, progress(f"bench {folder.name}")) for folder in folders]
    claims = [claim for one in measured for claim in one["claims"]]
    study = {
        "settings": asdict(config),
        "commit": commit(),
        "device": device_name(where),
        "runs": {run.name: {"asks": run.asks, **_trained(out / "runs" / run.name)} for run in chosen},
        "verdicts": answers(claims),
        "claims": claims,
        "reports": {folder.name: one["report"] for folder, one in zip(folders, measured, strict=True)},
    }
    write_whole(out / STUDY, (json.dumps(study, indent=1, allow_nan=False) + "\n").encode())
    write_whole(out / TEXT, to_markdown(study).encode())
    return study


def runs(config: ReproduceConfig) -> tuple[Run, ...]:
    """The runs that `config` names. Raises DatasetError for a name that is none."""
    known = {run.name: run for run in RUNS}
    if odd := [name for name in config.only if name not in known]:
        raise DatasetError(f"--only {printable(odd[0])}: no such run; known are {', '.join(known)}")
    return tuple(run for run in RUNS if not config.only or run.name in config.only)


def begin(out: Path, config: ReproduceConfig) -> None:
    """Begin a study in `out`, or go on with the one that was begun with `config`; which runs it has may change.

    Raises DatasetError where the folder holds a study of other settings, and where the disk refuses.
    """
    asked = {name: value for name, value in asdict(config).items() if name != "only"}
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise disk_error(out, error) from None
    there = _read(out / SETTINGS)
    if there is None:
        write_whole(out / SETTINGS, (json.dumps(asked, indent=1) + "\n").encode())
    elif unlike := differences(there, asked):
        raise DatasetError(f"{out}: was begun with other settings ({'; '.join(unlike)}); give those, or another --out")


def _read(path: Path) -> dict[str, Any] | None:
    """A JSON object; None where there is none, or it is damaged."""
    try:
        found = json.loads(read_bounded(path, MOST_MANIFEST_BYTES))
    except (OSError, DatasetError, ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def _dataset(folder: Path, kind: str, config: ReproduceConfig, workers: int, shown: "Progress") -> Path:
    """Made, or gone on with; shards that are damaged are made again."""
    recipe = preset(kind)
    plan = plan_dataset(folder, recipe, DrawnWorlds(recipe), seed=config.seed, counts=config.counts, compact=True)
    with shown:
        build(
            plan,
            workers=workers,
            on_start=lambda: shown.start(plan.samples),
            on_shard=lambda report, fresh: shown.count(report.samples),
        )
    return folder


def _train(
    out: Path,
    folders: Sequence[Path],
    config: ReproduceConfig,
    device: str,
    shown: "Progress | None",
    run: Run,
) -> int:
    """Train, or go on; a run whose state is damaged begins again. Returns the maps that are not yet counted."""
    if device == "cpu":
        torch.set_num_threads(1)
    folder, settings = out / "runs" / run.name, run.config(config.scaled(config.maps))
    step = (lambda maps, loss: shown.count(maps)) if shown else (lambda maps, loss: None)

    def go_on() -> None:
        train(
            opened(folders, "train"),
            opened(folders, "val"),
            settings,
            folder,
            device=device,
            command=f"scenegen reproduce --only {run.name}",
            watcher=Watcher(on_step=step),
        )

    try:
        go_on()
        load_network(folder / BEST)
    except CheckpointError:
        shutil.rmtree(folder)
        go_on()
    return 0 if shown else settings.maps or 0


def _trained(folder: Path) -> dict[str, Any]:
    """What is told of a finished run: its settings, its hardware, its network's digest."""
    held = _read(folder / CONFIG)
    if held is None:
        raise DatasetError(f"{folder / CONFIG}: is damaged; remove the folder, and the run is made again")
    return {name: held.get(name) for name in ("settings", "device", "commit")} | {"sha256": _sha256(folder / BEST)}


def _measure(
    out: Path, folder: Path, chosen: Sequence[Run], config: ReproduceConfig, workers: int, shown: "Progress"
) -> dict[str, Any]:
    """The bench of every network on one dataset, and the claims; kept while networks, data and settings stay."""
    networks = [out / "runs" / run.name for run in chosen]
    dataset, file = Dataset(folder), out / "bench" / f"{folder.name}.json"
    benched = BenchConfig(trials=config.scaled(TRIALS), seed=config.seed, study=True)
    stamp = {
        "networks": [_sha256(network / BEST) for network in networks],
        "dataset": str(dataset.manifest.digest),
        "bench": json.loads(json.dumps(asdict(benched))),
    }
    held = _read(file)
    if held is not None and held.get("stamp") == stamp and held.get("sha256") == _digest(held):
        return held
    unlearned: list[Method] = [Completed(Returns()), Completed(Extrude()), Truth(), Seen()]
    with shown:
        result = bench(
            dataset,
            [*unlearned, *(Pretrained(str(network)) for network in networks)],
            benched,
            workers=workers,
            on_start=shown.start,
            on_done=shown.count,
        )
    found = {
        "stamp": stamp,
        "report": build_report([result], seed=config.seed, about={"split": benched.split}),
        "claims": judged(result, seeds=SEEDS, seed=config.seed),
    }
    found = json.loads(json.dumps(found, allow_nan=False))
    found["sha256"] = _digest(found)
    file.parent.mkdir(exist_ok=True)
    write_whole(file, (json.dumps(found, indent=1) + "\n").encode())
    return found


def _digest(found: dict[str, Any]) -> str:
    """The SHA-256 of all but itself."""
    text = json.dumps({name: value for name, value in found.items() if name != "sha256"}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
