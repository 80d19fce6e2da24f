"""The bench of a study: every row is measured once, and kept while its network, its data and its
settings stay."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scenegen.dataset.locate import file_sha256
from scenegen.dataset.read import Dataset
from scenegen.model.completion.unlearned import Extrude, Returns
from scenegen.model.config import Thresholds
from scenegen.model.evaluation.config import BenchConfig
from scenegen.model.evaluation.keep import keep, kept
from scenegen.model.evaluation.methods import Completed, Method, Truth
from scenegen.model.evaluation.pretrained import Pretrained
from scenegen.model.evaluation.run import DatasetResult, bench
from scenegen.model.evaluation.seen import Seen
from scenegen.model.reproduce.config import ReproduceConfig
from scenegen.model.reproduce.runs import Run
from scenegen.model.training.run_folder import BEST
from scenegen.run.workers import run as run_workers

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
