"""Publish: verify, stage, send."""

from collections.abc import Callable
from dataclasses import dataclass

from scenegen.errors import PublishError
from scenegen.share.stage import Request, Staged, examine, stage
from scenegen.share.upload import check_token, upload


@dataclass(frozen=True, kw_only=True)
class Published:
    """What came of it."""

    staged: Staged
    commit: str | None
    """The commit on the Hub; None after a dry run."""


def publish(
    request: Request,
    *,
    dry_run: bool = False,
    private: bool = False,
    quick: bool = False,
    workers: int = 1,
    shown: bool = False,
    on_start: Callable[[int], None] = lambda total: None,
    on_done: Callable[[int], None] = lambda samples: None,
    on_staged: Callable[[Staged], None] = lambda staged: None,
) -> Published:
    """Verify the dataset with `workers` processes, put the folder together, and send it unless this
    is a `dry_run`.

    `quick` verifies with the cheap checks alone. No server is contacted before the folder is
    complete; a dry run contacts none. Raises DatasetError, PublishError.
    """
    from scenegen.verification import verify

    if not dry_run:
        check_token()
    examine(request)
    report = verify(
        request.dataset,
        quick=quick,
        kind=request.kind,
        workers=workers,
        on_start=on_start,
        on_done=on_done,
    )
    failed = [check for check in report.checks if not check.ok]
    if not report.ok:
        first = f" {failed[0].name}: {failed[0].detail};" if failed else ""
        raise PublishError(
            f"{request.dataset}: does not pass `scenegen verify`:{first} nothing is published; "
            f"generate it again"
        )
    checks = tuple(
        (check.name, f"{'not checked, ' * check.skipped}{check.detail}") for check in report.checks
    )
    staged = stage(request, checks)
    on_staged(staged)
    return Published(
        staged=staged, commit=None if dry_run else upload(staged, private=private, shown=shown)
    )
