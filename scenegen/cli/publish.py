"""`scenegen publish`: a verified dataset, and its folder for the Hugging Face Hub."""

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click

from scenegen.cli.options import (
    command,
    dataset_argument,
    executing,
    group,
    kind_option,
    out_option,
    printing,
)
from scenegen.cli.show import (
    ProgressBar,
    Reporter,
    announce_compilation,
    info,
    seconds_taken,
    show_table,
)
from scenegen.publish import USUAL

if TYPE_CHECKING:
    from scenegen.publish.stage import Staged


@command(
    "publish data/pillar --repo user/pillar --dry-run",
    "publish data/pillar --repo user/pillar --tag v1 --licence CC-BY-4.0",
)
@dataset_argument
@click.option(
    "--repo", required=True, metavar="USER/NAME", help="Dataset repository on the Hugging Face Hub."
)
@click.option("--tag", help="Name of the revision.  [default: by the content]")
@click.option(
    "--licence",
    "--license",
    default=USUAL,
    help="SPDX name of the data's licence.",
)
@out_option("The folder to make.  [default: publish/<name>]")
@click.option("--private", is_flag=True, help="Make a new repository private.")
@click.option(
    "--dry-run",
    is_flag=True,
    help="Make the folder and list the files to upload, without contacting the Hub.",
)
@click.option("--quick", is_flag=True, help="Run only fast checks: files, digests, numbers, laws.")
@kind_option
@executing
@printing
@group("On the Hub", "repo tag licence private")
def publish(
    dataset: Path | str,
    repo: str,
    tag: str | None,
    licence: str,
    out: Path | None,
    kind: str | None,
    report_result: Reporter,
    verbose: bool,
    **options: Any,
) -> None:
    """Verify a dataset, make a folder of it, and send that to the Hugging Face Hub.

    The same command continues a stopped run. The token is that of `hf auth login`, or HF_TOKEN.

    \f
    Raises:
        DatasetError: The dataset is damaged.
        PublishError: A check fails, or the Hub refuses.
    """
    if verbose:
        announce_compilation()
    # after the announcement, since these imports may take seconds
    from scenegen.base.executors import check_together
    from scenegen.base.paths import check_type
    from scenegen.dataset.locate import locate
    from scenegen.publish.stage import Request
    from scenegen.publish.upload import publish as run_publish

    check_type(dataset, "dataset")  # selections and collections have no folder to publish
    check_together(options["execute"], "publish takes")
    request = Request(
        dataset=locate(dataset, show_progress=verbose, whole=True),
        repository=repo,
        out=out or Path("publish") / repo.rpartition("/")[2],
        tag=tag,
        licence=licence,
        kind=kind,
    )
    with ProgressBar("verify", visible=verbose) as progress:

        def report(staged: Any) -> None:
            progress.stop()  # the Hub's client has its own bar
            if verbose:
                next_step = (
                    "Nothing is uploaded (--dry-run)." if options["dry_run"] else "Uploading …"
                )
                info(f"Wrote {staged.folder}. {next_step}")

        staged, commit = run_publish(
            request,
            show_progress=verbose,
            on_start=progress.start,
            on_done=progress.count,
            on_staged=report,
            **options,
        )
    size, seconds = sum(staged.files.values()), seconds_taken()
    sent = {"folder": str(staged.folder), "commit": commit, "bytes": size, "seconds": seconds}
    if report_result(vars(staged) | sent):
        _show_staged(staged, commit, size, seconds)


def _show_staged(staged: "Staged", commit: str | None, size: int, seconds: float) -> None:
    """Print the folder and what was sent; after a dry run, the files to send."""
    from scenegen.dataset.schema import pattern_of
    from scenegen.publish.upload import IN_COMMIT

    rows = {
        "folder": staged.folder,
        "files": f"{len(staged.files)}, {size / 1e6:.1f} MB",
        "commits": f"at most {-(-len(staged.files) // IN_COMMIT)}",
        "revision": f"hf://{staged.repository}@{staged.tag}",
        "time": f"{seconds:.1f} s",
    }
    if commit is None:
        # one line for all shards of a split, of which there may be thousands
        listed = Counter[str]()
        for name, size in staged.files.items():
            listed[pattern_of(name)] += size
        show_table(
            {name: f"{size:>15,}" for name, size in listed.items()}, "would be uploaded, in bytes"
        )
        show_table(rows | {"next": "the same command without --dry-run"}, "ready")
    else:
        rows["page"] = f"https://huggingface.co/datasets/{staged.repository}/tree/{staged.tag}"
        show_table(rows, "published")
