"""From a seed to the study's report, stage by stage: what is there is kept, what is damaged is made
again."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from scenegen.dataset.build import build, plan_dataset
from scenegen.dataset.locate import file_sha256
from scenegen.dataset.manifest import differences
from scenegen.errors import DatasetError, printable
from scenegen.files import disk_error, read_bounded, write_whole
from scenegen.limits import MOST_MANIFEST_BYTES
from scenegen.model.checkpoint import CheckpointError, load_network
from scenegen.model.evaluation.metrics import METRICS, PLAN_METRICS
from scenegen.model.evaluation.report import build_report
from scenegen.model.evaluation.run import DatasetResult
from scenegen.model.reproduce.claims import judge
from scenegen.model.reproduce.config import ReproduceConfig
from scenegen.model.reproduce.records import Measured, Records
from scenegen.model.reproduce.report import SHOWN, draw, to_markdown
from scenegen.model.reproduce.rows import measure, rows_of
from scenegen.model.reproduce.runs import ELSEWHERE, KINDS, RUNS, Run
from scenegen.model.training.card import read_rows
from scenegen.model.training.data import opened
from scenegen.model.training.device import choose_device
from scenegen.model.training.loop import Watcher, train
from scenegen.model.training.run_folder import BEST, CONFIG, ROWS, RunFolder
from scenegen.recipe import make_recipe
from scenegen.run.software import commit
from scenegen.run.workers import run as run_workers
from scenegen.source import DrawnWorlds

if TYPE_CHECKING:
    from scenegen.cli.show import Progress

SETTINGS, RECORDS, STUDY, TEXT, FIGURES = (
    "settings.json",
    "records.npz",
    "study.json",
    "study.md",
    "figures",
)
CURVE = ("maps", "seconds", "train_loss", "val_loss", "val_occupancy", "val_iou", "val_near_rmse")
"""What is told of every round of a run."""
VARIED = ("planning", "by_range")
UNSHOWN = {*METRICS, *PLAN_METRICS} - {"iou", "near_mae", "success"}
"""Parts of a bench's study, and the metrics that nothing shows of them."""


def reproduce(
    out: Path,
    config: ReproduceConfig,
    *,
    device: str = "auto",
    workers: int = 1,
    progress: Callable[[str], "Progress"],
) -> dict[str, Any]:
    """Make the study of `config` in the folder `out`, or go on with it, and return what
    ``study.json`` holds.

    On a CPU, `workers` networks are trained side by side, one thread each; on a GPU, one after the
    other. Raises DatasetError for a folder that holds another study, and what its stages raise.
    """
    begin(out, config)
    chosen = runs(config)
    done = [run for run in RUNS if run in chosen or _complete(out / "runs" / run.name, run, config)]
    worlds = list(dict.fromkeys(["", *(run.worlds for run in done)]))
    folders = {name: _datasets(out / "data", name, config, workers, progress) for name in worlds}
    where = choose_device(device)
    with progress("networks") as shown:
        shown.start(sum(run.config(config.scaled(config.maps)).maps or 0 for run in chosen))
        work = partial(_train, out, folders, config, str(where), shown if workers == 1 else None)
        side_by_side = 1 if where.type == "cuda" else workers
        for maps in run_workers(work, chosen, side_by_side, lambda: None):
            shown.count(maps)
    found = measure(list(rows_of(out, folders, done, config)), workers, progress("bench"))
    measured = {name: [found[folder] for folder in several] for name, several in folders.items()}
    records = Records(
        runs={run.name: _told(run, out / "runs" / run.name) for run in done},
        measured=tuple(
            Measured.of(name, one) for name, several in measured.items() for one in several
        ),
    )
    records.write(out / RECORDS)
    presets, short = measured.pop(""), {run.name for run in done if run.share < 1}
    study = {
        "settings": {name: value for name, value in asdict(config).items() if name != "only"},
        "commit": commit(),
        "missing": [run.name for run in RUNS if run not in done],
        "runs": records.runs,
        **judge(records),
        "report": _shown(_report(presets, lambda name: name not in short)),
        "short": _brief(_report(presets, lambda name: name in short)),
        "elsewhere": {
            name: {
                "asks": ELSEWHERE[name].asks,
                "report": _brief(_report(several, lambda name: True)),
            }
            for name, several in measured.items()
        },
    }
    write_whole(out / STUDY, (json.dumps(study, allow_nan=False) + "\n").encode())
    write_whole(out / TEXT, to_markdown(study).encode())
    (out / FIGURES).mkdir(exist_ok=True)
    for name, picture in draw(study).items():
        write_whole(out / FIGURES / name, picture)
    return study


def runs(config: ReproduceConfig) -> tuple[Run, ...]:
    """The runs that `config` names. Raises DatasetError for a name that is none."""
    known = {run.name: run for run in RUNS}
    if odd := [name for name in config.only if name not in known]:
        raise DatasetError(f"--only {printable(odd[0])}: no such run; known are {', '.join(known)}")
    return tuple(run for run in RUNS if not config.only or run.name in config.only)


def begin(out: Path, config: ReproduceConfig) -> None:
    """Begin a study in `out`, or go on with the one that was begun with `config`; which runs it has
    may change.

    Raises DatasetError where the folder holds a study of other settings, and where the disk
    refuses.
    """
    asked = {name: value for name, value in asdict(config).items() if name != "only"}
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise disk_error(out, error) from None
    there = _read(out / SETTINGS)
    if there is None:
        if taken := next(
            (name for name in (SETTINGS, STUDY, TEXT, FIGURES) if (out / name).exists()), None
        ):
            raise DatasetError(f"{out}: holds {taken}, and no study of ours; choose another --out")
        write_whole(out / SETTINGS, (json.dumps(asked, indent=1) + "\n").encode())
    elif unlike := differences(there, asked):
        raise DatasetError(
            f"{out}: was begun with other settings ({'; '.join(unlike)}); give those, or another "
            f"--out"
        )


def _read(path: Path) -> dict[str, Any] | None:
    """A JSON object; None where there is none, or it is damaged."""
    try:
        found = json.loads(read_bounded(path, MOST_MANIFEST_BYTES))
    except (OSError, DatasetError, ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def _datasets(
    folder: Path,
    worlds: str,
    config: ReproduceConfig,
    workers: int,
    progress: Callable[[str], "Progress"],
) -> list[Path]:
    """Those of all kinds in `worlds`, made or gone on with; shards that are damaged are made
    again."""
    made = []
    for kind in KINDS:
        recipe = make_recipe(
            kind, dict(ELSEWHERE[worlds].tables[kind]) if worlds else {}, where=worlds
        )
        plan = plan_dataset(
            folder / worlds / kind,
            recipe,
            DrawnWorlds(recipe),
            seed=config.seed,
            counts=config.counts,
            compact=True,
        )
        shown = progress(f"{worlds} {kind}".strip())
        with shown:
            build(
                plan,
                workers=workers,
                on_start=partial(shown.start, plan.samples),
                on_shard=partial(_count, shown),
            )
        made.append(plan.folder)
    return made


def _count(shown: "Progress", report: Any, fresh: bool) -> None:
    shown.count(report.samples)


def _train(
    out: Path,
    folders: Mapping[str, Sequence[Path]],
    config: ReproduceConfig,
    device: str,
    shown: "Progress | None",
    run: Run,
) -> int:
    """Train, or go on; a run whose state is damaged begins again. Returns the maps that are not yet
    counted."""
    if device == "cpu":
        torch.set_num_threads(1)
    folder, settings = out / "runs" / run.name, run.config(config.scaled(config.maps))
    step = (lambda maps, loss: shown.count(maps)) if shown else (lambda maps, loss: None)

    def go_on() -> None:
        train(
            opened(folders[run.worlds], "train", run.samples),
            opened(folders[run.worlds], "val"),
            settings,
            folder,
            device=device,
            command=f"scenegen reproduce --only {run.name}",
            watcher=Watcher(on_step=step),
        )

    try:
        if not _complete(folder, run, config):  # which needs no state to go on from
            go_on()
        load_network(folder / BEST)
    except CheckpointError:
        RunFolder(folder).clear()
        go_on()
    return 0 if shown else settings.maps or 0


def _complete(folder: Path, run: Run, config: ReproduceConfig) -> bool:
    """Whether `folder` holds `run` to its last map, as `config` has it."""
    asked = run.config(config.scaled(config.maps))
    if asked.maps is None or not (folder / ROWS).exists() or not (folder / CONFIG).exists():
        return False
    there = RunFolder(folder).settings()
    given = json.loads(json.dumps(asdict(asked)))
    given["network"]["height"] = there["network"][
        "height"
    ]  # which the data give, as the device does the precision
    if differences(
        there, there | {name: value for name, value in given.items() if name != "precision"}
    ):
        return False
    return read_rows(folder / ROWS)[-1]["maps"] > asked.maps - asked.batch


def _told(run: Run, folder: Path) -> dict[str, Any]:
    """What is told of a finished run: what it is for, its settings, hardware, time and curve, its
    network's digest."""
    held = _read(folder / CONFIG)
    if held is None:
        raise DatasetError(
            f"{folder / CONFIG}: is damaged; remove the folder, and the run is made again"
        )
    curve = read_rows(folder / ROWS)
    return {
        "asks": run.asks,
        "against": run.against,
        "seed": run.seed,
        "samples": held["settings"]["samples"],
        "maps": curve[-1]["maps"],
        "hours": sum(row["seconds"] for row in curve) / 3600,
        "curve": [{name: row[name] for name in CURVE if name in row} for row in curve],
        "sha256": file_sha256(folder / BEST),
    } | {name: held.get(name) for name in ("settings", "device", "commit", "command")}


def _report(measured: Sequence[DatasetResult], named: Callable[[str], bool]) -> dict[str, Any]:
    """The bench's report of those rows whose names are `named`, to five digits."""
    chosen = [
        replace(one, methods={name: row for name, row in one.methods.items() if named(name)})
        for one in measured
    ]
    studied = [all(row.study is not None for row in one.methods.values()) for one in chosen]
    chosen = [
        replace(one, config=replace(one.config, study=whole))
        for one, whole in zip(chosen, studied, strict=True)
    ]
    report = build_report(chosen, seed=0, about={"split": measured[0].config.split}, tests=False)
    return dict(
        json.loads(json.dumps(report), parse_float=lambda digits: float(f"{float(digits):.5g}"))
    )


def _shown(report: Mapping[str, Any]) -> dict[str, Any]:
    """A report with only what the text and the figures show of its study."""

    def slim(row: Mapping[str, Any]) -> dict[str, Any]:
        rows = {
            name: [{k: v for k, v in one.items() if k not in UNSHOWN} for one in row[name]]
            for name in VARIED
        }
        held = row["reliability"]
        return {**row, **rows, "reliability": held and {"map": held["map"]}}

    studied = report.get("study", {})
    return {
        **report,
        "study": {
            kind: {name: slim(row) for name, row in rows.items()} for kind, rows in studied.items()
        },
    }


def _brief(report: Mapping[str, Any]) -> dict[str, Any]:
    """Those of its figures that the text shows."""
    return {
        table: {
            kind: {row: {name: figures[name] for name in names} for row, figures in rows.items()}
            for kind, rows in report[table].items()
        }
        for table, names in SHOWN.items()
    }
