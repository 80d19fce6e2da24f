"""The bench of a study, row by row, and what a study will take before it begins."""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from lidarsim import GridSpec
from scenegen.dataset.locate import file_sha256
from scenegen.dataset.read import Dataset
from scenegen.model.completion.unlearned import Extrude, Returns
from scenegen.model.config import NetworkConfig, Thresholds, TrainConfig
from scenegen.model.evaluation.config import BenchConfig
from scenegen.model.evaluation.keep import keep, kept
from scenegen.model.evaluation.methods import Completed, Method, Truth
from scenegen.model.evaluation.pretrained import Pretrained
from scenegen.model.evaluation.run import DatasetResult, bench
from scenegen.model.evaluation.visibility import Seen
from scenegen.model.network import build, placed
from scenegen.model.reproduce.config import ReproduceConfig
from scenegen.model.reproduce.runs import Run
from scenegen.model.training.device import Group, choose_device, device_name, resolve_precision
from scenegen.model.training.loop import Step, optimizer_of
from scenegen.model.training.run_folder import BEST
from scenegen.run.workers import run as run_workers

SAMPLE_S, SAMPLE_BYTES = 0.006, 15e3
"""A sample of a compact dataset, one core: docs/log.md."""
ROW_S, STUDIED_S, UNLEARNED_S = 0.08, 0.15, 0.03
"""A row of the bench, one with its study, and all of those that need no network, by map and core,
planning included: docs/log.md."""
RUN_BYTES = 10e6
"""What a run's folder takes."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Hours and bytes of a study, on this machine."""

    device: str
    map_s: float
    """A training step's time by map, measured just now."""
    train_s: float
    generate_s: float
    bench_s: float
    bytes: float

    def words(self) -> dict[str, str]:
        """For people."""
        total = self.generate_s + self.train_s + self.bench_s
        return {
            "time": f"about {_time(total)}: datasets {_time(self.generate_s)}, networks "
            f"{_time(self.train_s)}, bench "
            f"{_time(self.bench_s)}",
            "disk": f"about {self.bytes / 1e6:.0f} MB",
            "on": f"{self.device}, {1e3 * self.map_s:.1f} ms a map of training",
        }


def estimate(
    config: ReproduceConfig, runs: Sequence[Run], *, device: str, workers: int
) -> Estimate:
    """Time two training steps of the paper's network, and add up the rest from measured
    constants."""
    where = choose_device(device)
    maps = sum(run.config(config.scaled(config.maps)).maps or 0 for run in runs)
    worlds = {"", *(run.worlds for run in runs)}
    samples, tested = len(worlds) * 2 * sum(config.counts.values()), 2 * config.counts["test"]
    each = _map_seconds(where)
    return Estimate(
        device=device_name(where),
        map_s=each,
        train_s=maps * each / (1 if where.type == "cuda" else workers),
        generate_s=samples * SAMPLE_S / workers,
        bench_s=tested * (sum(map(_row_seconds, runs)) + len(worlds) * UNLEARNED_S) / workers,
        bytes=samples * SAMPLE_BYTES + len(runs) * RUN_BYTES,
    )


def _row_seconds(run: Run) -> float:
    return STUDIED_S if run.share == 1 else ROW_S


def _map_seconds(device: torch.device) -> float:
    config = TrainConfig(network=NetworkConfig())
    network, threads = placed(build(config.network), device), torch.get_num_threads()
    precision = resolve_precision(config.precision, device)
    learn = Step(
        network, optimizer_of(network, config), config, GridSpec(), device, precision, Group(device)
    )
    batch = {
        name: torch.rand(config.batch, *GridSpec().shape) > 0.97
        for name in ("observed", "occupancy")
    }
    try:
        torch.set_num_threads(1)
        learn(batch, 0.0)
        begin = time.perf_counter()
        learn(batch, 0.0)
        return (time.perf_counter() - begin) / config.batch
    finally:
        torch.set_num_threads(threads)


def _time(seconds: float) -> str:
    return f"{seconds / 3600:.1f} h" if seconds > 3600 else f"{max(seconds / 60, 1):.0f} min"


if TYPE_CHECKING:
    from scenegen.cli.show import Progress

TRIALS = 2000
"""Planning trials a kind at scale 1 (the paper's)."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One part of the bench of a dataset."""

    dataset: Path
    file: Path
    """Where it is kept."""
    methods: tuple[Method, ...]
    config: BenchConfig
    stamp: dict[str, Any]
    """What it is measured on: it is kept while that stays."""


def rows_of(
    out: Path, folders: Mapping[str, Sequence[Path]], done: Sequence[Run], config: ReproduceConfig
) -> Iterator[Row]:
    """For each dataset what needs no network, then every network of `done` on the worlds that it is
    of.

    Networks with the whole budget are studied, and so is, on the presets, what needs no network;
    others have their rows in the tables.
    """
    for worlds, folder in (
        (worlds, folder) for worlds, several in folders.items() for folder in several
    ):
        usual = BenchConfig(trials=config.scaled(TRIALS), seed=config.seed, study=not worlds)
        unlearned = Completed(Returns()), Completed(Extrude()), Truth(), Seen()
        parts: list[tuple[str, str, tuple[Method, ...], BenchConfig]] = [
            ("unlearned", "", unlearned, usual)
        ]
        for run in (run for run in done if run.worlds == worlds):
            network = out / "runs" / run.name
            at = replace(
                usual, study=run.share == 1, thresholds=Thresholds(probability=run.probability)
            )
            parts.append((run.name, file_sha256(network / BEST), (Pretrained(str(network)),), at))
        for name, network_digest, methods, asked in parts:
            digest = str(Dataset(folder).manifest.digest)
            yield Row(
                dataset=folder,
                file=out / "bench" / folder.relative_to(out / "data") / f"{name}.npz",
                methods=methods,
                config=asked,
                stamp={"network": network_digest, "dataset": digest, "bench": asdict(asked)},
            )


def _benched(row: Row) -> tuple[Path, DatasetResult]:
    result = kept(row.file, row.config, row.stamp)
    if result is None:
        result = bench(Dataset(row.dataset), row.methods, row.config)
        keep(row.file, result, row.stamp)
    return row.file, result


def measure(rows: Sequence[Row], workers: int, shown: "Progress") -> dict[Path, DatasetResult]:
    """The bench of every dataset, `workers` rows at a time."""
    with shown:
        shown.start(len(rows))
        found = {}
        for file, result in run_workers(_benched, rows, workers):
            found[file] = result
            shown.count(1)
    whole = {}
    for folder in dict.fromkeys(row.dataset for row in rows):
        parts = [found[row.file] for row in rows if row.dataset == folder]
        whole[folder] = replace(
            parts[0], methods={name: row for part in parts for name, row in part.methods.items()}
        )
    return whole
