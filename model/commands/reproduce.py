"""`scenegen reproduce`: the study of the paper's claims, from a seed to its report."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import rich_click as click

from scenegen.cli.options import (
    device_option,
    json_option,
    options_of,
    out_option,
    quiet_option,
    taken,
    workers_option,
)
from scenegen.cli.show import Progress, announce_compilation, say, show_table
from scenegen.model.study.runs import ReproduceConfig


@click.command()
@options_of(
    ReproduceConfig,
    scale="Share of all samples, maps and trials; 0.02 takes some ten minutes on two cores.",
    maps="Maps that every network sees, at scale 1.",
    seed="Decides datasets and goals.",
)
@click.option(
    "--only",
    multiple=True,
    metavar="RUN",
    help="A run to train, several times for several.  [default: all]",
)
@device_option
@out_option("Folder of the study.", default=Path("study"))
@click.option(
    "--from",
    "records",
    type=click.Path(path_type=Path),
    metavar="RECORDS",
    help="Judge the claims again from a study's records.npz, and do nothing else; all of it with "
    "--json.",
)
@click.option("--dry-run", is_flag=True, help="Say what it would take, and do nothing.")
@workers_option
@json_option
@quiet_option
def reproduce(
    device: str,
    out: Path,
    records: Path | None,
    workers: int,
    dry_run: bool,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Repeat the study of the paper's claims: datasets, networks, bench, verdicts.

    Given again after a stop, it goes on where it was.
    """
    if records is not None:
        _judge_again(records, as_json)
        return
    from scenegen.model.study.stages import RECORDS, STUDY, TEXT, Study

    talk = not (quiet or as_json)
    config = ReproduceConfig(**taken(ReproduceConfig, options))
    study = Study(out=out, config=config, device=device, workers=workers)
    if talk or dry_run:
        takes = study.takes()
        print(json.dumps(takes)) if as_json else show_table(takes)
    if dry_run:
        return
    if talk:
        announce_compilation()
    found = study.make(lambda label: Progress(label, shown=talk))
    if as_json:
        print(json.dumps({"folder": str(out), "verdicts": found["verdicts"]}))
    elif talk:
        _show_verdicts(found)
        say(f"written: {out / TEXT}, {out / STUDY}, {out / RECORDS}")


def _judge_again(path: Path, as_json: bool) -> None:
    from scenegen.model.study.claims import summary
    from scenegen.model.study.records import Records

    found = summary(Records.read(path))
    if as_json:
        print(json.dumps(found, allow_nan=False))
    else:
        _show_verdicts(found)


def _show_verdicts(study: dict[str, Any]) -> None:
    """The questions' answers, and how many claims have which verdict."""
    counts = Counter(claim["verdict"] for claim in study["claims"])
    told = ", ".join(f"{count} {verdict}" for verdict, count in sorted(counts.items()))
    show_table(
        {name: said["verdict"] for name, said in study["verdicts"].items()} | {"claims": told}
    )
