"""From a seed to the study's report, stage by stage: what is there is kept, what is damaged is made
again."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from scenegen.dataset.build import build, plan_dataset
from scenegen.dataset.locate import file_sha256
from scenegen.dataset.manifest import differences
from scenegen.dataset.read import Dataset
from scenegen.errors import DatasetError, printable
from scenegen.files import disk_error, read_bounded, write_whole
from scenegen.limits import MOST_MANIFEST_BYTES
from scenegen.model.checkpoint import CheckpointError, load_network
from scenegen.model.completion.unlearned import Extrude, Returns
from scenegen.model.config import Thresholds
from scenegen.model.evaluation.config import BenchConfig
from scenegen.model.evaluation.methods import Completed, Method, Truth
from scenegen.model.evaluation.pretrained import Pretrained
from scenegen.model.evaluation.run import bench
from scenegen.model.evaluation.visibility import Seen
from scenegen.model.study.claims import summary
from scenegen.model.study.records import Measured, Records
from scenegen.model.study.report import to_markdown
from scenegen.model.study.runs import KINDS, RUNS, ReproduceConfig, Run, Worlds
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

SETTINGS, RECORDS, STUDY, TEXT = "settings.json", "records.npz", "study.json", "study.md"
CURVE = ("maps", "seconds", "train_loss", "val_loss", "val_occupancy", "val_iou", "val_near_rmse")
"""What is told of every look at validation."""
TRIALS = 2000
"""Planning trials a kind at scale 1 (the paper's)."""
UNLEARNED = Completed(Returns()), Completed(Extrude()), Truth(), Seen()


@dataclass(frozen=True, kw_only=True)
class Study:
    """A study in a folder: its size, its runs, and the worlds that these name."""

    out: Path
    config: ReproduceConfig
    runs: tuple[Run, ...] = RUNS
    worlds: Mapping[str, Worlds] = field(default_factory=dict)
    device: str = "auto"
    workers: int = 1
    """Networks that are trained side by side on a CPU, one thread each; on a GPU, it is one."""

    def chosen(self) -> tuple[Run, ...]:
        """The runs that the configuration names. Raises DatasetError for a name that is none."""
        known = {run.name: run for run in self.runs}
        if odd := [name for name in self.config.only if name not in known]:
            raise DatasetError(
                f"--only {printable(odd[0])}: no such run; known are {', '.join(known)}"
            )
        return tuple(
            run for run in self.runs if not self.config.only or run.name in self.config.only
        )

    def takes(self) -> dict[str, str]:
        """What it will take, for people."""
        runs = self.chosen()
        maps = sum(self.settings(run).maps or 0 for run in runs)
        samples = sum(self.config.counts.values()) * len(KINDS) * len({run.worlds for run in runs})
        return {
            "datasets": f"{samples} samples",
            "networks": f"{len(runs)}, {maps} maps of training in all",
            "bench": f"{self.config.scaled(TRIALS)} trials a kind and network",
        }

    def settings(self, run: Run) -> Any:
        """A run's settings at this scale."""
        return run.config(self.config.scaled(self.config.maps))

    def begin(self) -> None:
        """Begin in the folder, or go on with what was begun there with the same settings; which
        runs it has may change.

        Raises DatasetError where the folder holds a study of other settings, and where the disk
        refuses.
        """
        asked = {name: value for name, value in asdict(self.config).items() if name != "only"}
        try:
            self.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise disk_error(self.out, error) from None
        there = read_json(self.out / SETTINGS)
        if there is None:
            for name in (SETTINGS, STUDY, TEXT):
                if (self.out / name).exists():
                    raise DatasetError(
                        f"{self.out}: holds {name}, and no study of ours; choose another --out"
                    )
            write_whole(self.out / SETTINGS, (json.dumps(asked, indent=1) + "\n").encode())
        elif unlike := differences(there, asked):
            raise DatasetError(
                f"{self.out}: was begun with other settings ({'; '.join(unlike)}); give those, or "
                f"another --out"
            )

    def make(self, progress: Callable[[str], "Progress"]) -> dict[str, Any]:
        """Make it, or go on with it, and return what ``study.json`` holds. Raises what its stages
        raise."""
        self.begin()
        chosen = self.chosen()
        done = [run for run in self.runs if run in chosen or self.complete(run)]
        names = list(dict.fromkeys(["", *(run.worlds for run in done)]))
        folders = {name: self._datasets(name, progress) for name in names}
        self._train_all(chosen, folders, progress)
        records = Records(
            runs={run.name: self._told(run) for run in done},
            measured=tuple(self._measure(done, folders, progress)),
        )
        records.write(self.out / RECORDS)
        study = {
            "settings": {k: v for k, v in asdict(self.config).items() if k != "only"},
            "commit": commit(),
            "missing": [run.name for run in self.runs if run not in done],
            **summary(records),
        }
        write_whole(self.out / STUDY, (json.dumps(study, allow_nan=False) + "\n").encode())
        write_whole(self.out / TEXT, to_markdown(study).encode())
        return study

    def _datasets(self, worlds: str, progress: Callable[[str], "Progress"]) -> list[Path]:
        """Datasets of all kinds in `worlds`, made or gone on with; damaged shards are made
        again."""
        made = []
        for kind in KINDS:
            tables = dict(self.worlds[worlds].tables[kind]) if worlds else {}
            recipe = make_recipe(kind, tables, where=worlds)
            plan = plan_dataset(
                self.out / "data" / worlds / kind,
                recipe,
                DrawnWorlds(recipe),
                seed=self.config.seed,
                counts=self.config.counts,
                compact=True,
            )
            shown = progress(f"{worlds} {kind}".strip())
            with shown:
                build(
                    plan,
                    workers=self.workers,
                    on_start=partial(shown.start, plan.samples),
                    on_shard=partial(_count, shown),
                )
            made.append(plan.folder)
        return made

    def _train_all(
        self,
        chosen: Sequence[Run],
        folders: Mapping[str, Sequence[Path]],
        progress: Callable[[str], "Progress"],
    ) -> None:
        where = choose_device(self.device)
        with progress("networks") as shown:
            shown.start(sum(self.settings(run).maps or 0 for run in chosen))
            work = partial(self._train, folders, str(where), shown if self.workers == 1 else None)
            side_by_side = 1 if where.type == "cuda" else self.workers
            for maps in run_workers(work, chosen, side_by_side, lambda: None):
                shown.count(maps)

    def _train(
        self,
        folders: Mapping[str, Sequence[Path]],
        device: str,
        shown: "Progress | None",
        run: Run,
    ) -> int:
        """Train, or go on; a run whose state is damaged begins again. Returns the maps that are not
        yet counted."""
        if device == "cpu":
            torch.set_num_threads(1)
        folder, settings = self.out / "runs" / run.name, self.settings(run)
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
            if not self.complete(run):  # which needs no state to go on from
                go_on()
            load_network(folder / BEST)
        except CheckpointError:
            RunFolder(folder).clear()
            go_on()
        return 0 if shown else settings.maps or 0

    def complete(self, run: Run) -> bool:
        """Whether the folder holds `run` to its last map, with these settings."""
        folder, asked = self.out / "runs" / run.name, self.settings(run)
        if not (folder / ROWS).exists() or not (folder / CONFIG).exists():
            return False
        there = RunFolder(folder).settings()
        given = json.loads(json.dumps(asdict(asked)))
        # the data give the height, and the device the precision
        given["network"]["height"] = there["network"]["height"]
        del given["precision"]
        if differences(there, there | given):
            return False
        return read_rows(folder / ROWS)[-1]["maps"] > (asked.maps or 0) - asked.batch

    def _told(self, run: Run) -> dict[str, Any]:
        """What is told of a finished run: what it is for, its settings, hardware, time and curve,
        its network's digest."""
        folder = self.out / "runs" / run.name
        held = read_json(folder / CONFIG)
        if held is None:
            raise DatasetError(
                f"{folder / CONFIG}: is damaged; remove the folder, and the run is made again"
            )
        curve = read_rows(folder / ROWS)
        return {
            "asks": run.asks,
            "against": run.against,
            "seed": run.seed,
            "worlds": run.worlds,
            "samples": held["settings"]["samples"],
            "maps": curve[-1]["maps"],
            "hours": sum(row["seconds"] for row in curve) / 3600,
            "curve": [{name: row[name] for name in CURVE if name in row} for row in curve],
            "sha256": file_sha256(folder / BEST),
        } | {name: held.get(name) for name in ("settings", "device", "commit", "command")}

    def _measure(
        self,
        done: Sequence[Run],
        folders: Mapping[str, Sequence[Path]],
        progress: Callable[[str], "Progress"],
    ) -> Iterator[Measured]:
        """The bench of every dataset, `workers` rows at a time. A row is measured once, and kept
        while its network, its data and its settings stay."""
        tasks = [task for name in folders for task in self._rows(name, folders[name], done)]
        with progress("bench") as shown:
            shown.start(len(tasks))
            found = {}
            for file, one in run_workers(measured, tasks, self.workers):
                found[file] = one
                shown.count(1)
        for dataset in dict.fromkeys(task.dataset for task in tasks):
            yield Measured.joined([found[task.file] for task in tasks if task.dataset == dataset])

    def _rows(self, where: str, folders: Sequence[Path], done: Sequence[Run]) -> Iterator["Row"]:
        usual = BenchConfig(trials=self.config.scaled(TRIALS), seed=self.config.seed)
        for folder in folders:
            kept = self.out / "bench" / folder.relative_to(self.out / "data")
            digest = str(Dataset(folder).manifest.digest)
            stamp = {"dataset": digest, "bench": asdict(usual)}
            yield Row(where, folder, kept / "unlearned.npz", UNLEARNED, usual, stamp)
            for run in (run for run in done if run.worlds == where):
                network = self.out / "runs" / run.name
                at = BenchConfig(
                    trials=usual.trials,
                    seed=usual.seed,
                    thresholds=Thresholds(probability=run.probability),
                )
                stamp = {
                    "dataset": digest,
                    "bench": asdict(at),
                    "network": file_sha256(network / BEST),
                }
                row = (Pretrained(str(network)),)
                yield Row(where, folder, kept / f"{run.name}.npz", row, at, stamp)


def _count(shown: "Progress", report: Any, fresh: bool) -> None:
    shown.count(report.samples)


@dataclass(frozen=True)
class Row:
    """One part of the bench of a dataset."""

    where: str
    dataset: Path
    file: Path
    """Where it is kept."""
    methods: tuple[Method, ...]
    config: BenchConfig
    stamp: dict[str, Any]
    """What it is measured on."""


def measured(row: Row) -> tuple[Path, Measured]:
    """A row's file, and the row as it is kept there, or measured now."""
    stamp = json.loads(json.dumps(row.stamp))
    try:
        held = Records.read(row.file)
        if held.runs == stamp:
            return row.file, held.measured[0]
    except DatasetError:  # there is none, or it is damaged
        pass
    found = Measured.of(row.where, bench(Dataset(row.dataset), row.methods, row.config))
    Records(runs=stamp, measured=(found,)).write(row.file)
    return row.file, found


def read_json(path: Path) -> dict[str, Any] | None:
    """A JSON object; None where there is none, or it is damaged."""
    try:
        found = json.loads(read_bounded(path, MOST_MANIFEST_BYTES))
    except (OSError, DatasetError, ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None
