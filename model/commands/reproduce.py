"""`scenegen reproduce`: the study of the paper's claims, from a seed to its report."""

from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

import rich_click as click

from scenegen.cli.options import (
    command,
    device_option,
    executing,
    options_of,
    out_option,
    printing,
)
from scenegen.cli.show import Progress, Tell, announce_compilation, say, show_table
from scenegen.cli.types import FILE
from scenegen.errors import DatasetError
from scenegen.files import Json
from scenegen.model.study.runs import KINDS, TRIALS, ReproduceConfig, chosen
from scenegen.run import Executor


@command("reproduce --scale 0.02", "reproduce --from study/study.json --json")
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
    help="A run to train and to judge, several times for several.  [default: all]",
)
@device_option
@out_option("Folder of the study.", default=Path("study"))
@click.option(
    "--from",
    "given",
    type=FILE,
    metavar="STUDY",
    help="Judge the claims again from the figures of a study.json, and do nothing else; all of it "
    "with --json.",
)
@click.option("--dry-run", is_flag=True, help="Print what it would take, and do nothing.")
@executing
@printing
def reproduce(
    only: tuple[str, ...],
    device: str,
    out: Path,
    given: Path | None,
    execute: Executor,
    dry_run: bool,
    tell: Tell,
    talk: bool,
    **options: Any,
) -> None:
    """Repeat the study of the paper's claims: datasets, networks, bench, verdicts.

    Given again after a stop, it goes on where it was.
    """
    from scenegen.model.study import claims, steps

    if given is not None:
        try:
            found = claims.judged(steps.read_json(given) or {})
        except (KeyError, TypeError, ValueError, AttributeError, IndexError):
            raise DatasetError(
                f"{given}: is no study; expected the study.json that reproduce wrote"
            ) from None
        if tell(found):
            _show_verdicts(found)
        return
    config, runs = ReproduceConfig(**options), chosen(only)
    if talk or dry_run:
        maps, samples = config.scaled(config.maps), sum(config.counts.values())
        takes = {
            "datasets": f"{samples * len(KINDS)} samples",
            "networks": f"{len(runs)}, {maps * len(runs)} maps of training in all",
            "bench": f"{config.scaled(TRIALS)} trials a kind and network",
        }
        if tell(takes):
            show_table(takes)
    if dry_run:
        return
    if talk:
        announce_compilation()
    found = steps.reproduce(
        out,
        config,
        runs,
        device=device,
        execute=execute,
        progress=partial(Progress, shown=talk),
    )
    if tell({"folder": str(out), "verdicts": found["verdicts"]}):
        _show_verdicts(found)
        say(f"written: {out / steps.TEXT}, {out / steps.STUDY}")


def _show_verdicts(study: Json) -> None:
    """The questions' answers, and how many claims have which verdict."""
    counts = Counter(claim["verdict"] for claim in study["claims"])
    told = ", ".join(f"{count} {verdict}" for verdict, count in sorted(counts.items()))
    show_table(
        {name: said["verdict"] for name, said in study["verdicts"].items()} | {"claims": told}
    )
