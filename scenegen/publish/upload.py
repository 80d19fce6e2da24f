"""Verifies and stages a dataset, and sends it to the Hugging Face Hub: first all files, then the
tag, once all have arrived.
"""

import re
from collections.abc import Callable
from typing import Any

from scenegen import __version__
from scenegen.base.errors import PublishError, ScenegenError, needs
from scenegen.base.executors import chunked
from scenegen.dataset.locate import client_output, file_sha256, reason
from scenegen.publish.stage import Request, Staged, examine, read_sums, stage

OURS = re.compile(
    r"((train|val|test)-\d+x+/)?(train|val|test)-\d{5,9}(\.h5|\.worlds\.zip)"
    r"|pictures/(train|val|test)-\d+\.png|look\.html|rays\.npy"
    r"|figures-\w{16}\.npy",
    re.ASCII,
)
"""Names of files that publish may delete from a repository, where another dataset left them."""
IN_COMMIT = 250
"""Maximum files of a commit: the Hub gives up on commits that take a minute."""
TOKEN = (
    "no token for the Hub: run `hf auth login`, or set HF_TOKEN, with one that may write; "
    "it is never an argument"
)


def check_token() -> None:
    """Check that the Hub's client is installed and has a token.

    Raises:
        PublishError: It is not, or has none.
    """
    try:
        from huggingface_hub import get_token
    except ImportError:
        raise PublishError(f"publishing {needs('huggingface_hub', 'publish')}") from None
    if not get_token():
        raise PublishError(TOKEN)


def upload(staged: Staged, *, private: bool, show_progress: bool) -> str:
    """Send a folder to the Hub.

    Called again after an interruption, it sends only the files that the Hub lacks. A tag that
    exists is never moved; it is accepted if it names the same files.

    Args:
        staged: The folder.
        private: Whether a new repository is private.
        show_progress: Whether the Hub's client shows its progress.

    Returns:
        The commit that the tag names.

    Raises:
        PublishError: The Hub refuses, or cannot be reached; or the tag has other content.
    """
    from huggingface_hub import HfApi

    api = HfApi(library_name="scenegen", library_version=__version__)
    try:
        with client_output(show_progress):
            return _send(api, staged, private)
    except ScenegenError:
        raise
    except Exception as error:  # any error of the Hub's client or the network
        raise PublishError(_explain(staged, error)) from None


def _send(api: Any, staged: Staged, private: bool) -> str:
    from huggingface_hub import CommitOperationAdd, CommitOperationDelete

    repository, target = staged.repository, f"hf://{staged.repository}"
    where = {"repo_id": repository, "repo_type": "dataset"}
    # None and not False: it leaves an organisation's own default as it is
    api.create_repo(**where, private=private or None, exist_ok=True)
    info = api.dataset_info(repository)
    if private and not info.private:
        raise PublishError(
            f"{target}: is there and public; leave --private out, or choose another --repo"
        )
    # a tag is a promise to those who cite it
    tags = {ref.name: ref.target_commit for ref in api.list_repo_refs(**where).tags}
    if staged.tag in tags:
        if wrong := differences(api, staged, tags[staged.tag]):
            raise PublishError(
                f"{target}: tag {staged.tag} is there with other content ({wrong[0]}); give "
                "another --tag"
            )
        return str(tags[staged.tag])
    stale = [
        path
        for path in api.list_repo_files(**where)
        if OURS.fullmatch(path) and path not in staged.files
    ]
    head = info.sha
    # shards first: the manifest and the card of an earlier dataset are replaced last
    names = sorted(
        [*differences(api, staged, head), *stale], key=lambda name: not OURS.fullmatch(name)
    )
    for part in chunked(names, IN_COMMIT):
        operations = [
            CommitOperationAdd(name, staged.folder / name)
            if name in staged.files
            else CommitOperationDelete(name)
            for name in part
        ]
        head = api.create_commit(
            operations=operations,
            commit_message=f"{staged.tag}: {staged.digest}",
            parent_commit=head,
            **where,
        ).oid  # a parent: the Hub refuses if another publisher's commit came in between
    # listed once more: the client does not check that all arrived, and a tag is for ever
    if wrong := differences(api, staged, head):
        raise PublishError(
            f"{target}: not everything arrived ({wrong[0]}); give the same command again to go on"
        )
    api.create_tag(**where, tag=staged.tag, revision=head)
    return str(head)


def differences(api: Any, staged: Staged, revision: str) -> list[str]:
    """Compare a folder with a repository.

    Args:
        api: The Hub's client.
        staged: The folder.
        revision: Commit of the repository.

    Returns:
        Names of files that the repository lacks, or has with other content.
    """
    from huggingface_hub.utils.sha import git_hash

    tree = api.list_repo_tree(
        staged.repository, repo_type="dataset", recursive=True, revision=revision
    )
    # the tree has folders, too, which are no blobs
    entries = {entry.path: entry for entry in tree if hasattr(entry, "blob_id")}
    sums = read_sums(staged.folder)

    # the Hub has a SHA-256 of large files, and Git's hash of small ones
    def is_there(name: str) -> bool:
        entry, path = entries.get(name), staged.folder / name
        if entry is None or entry.lfs is None:
            return entry is not None and entry.blob_id == git_hash(path.read_bytes())
        return bool(entry.lfs.sha256 == (sums.get(name) or file_sha256(path)))

    return [name for name in staged.files if not is_there(name)]


def _explain(staged: Staged, error: Exception) -> str:
    """Return one line for an error: what failed, and what to do."""
    target = f"hf://{staged.repository}"
    status = getattr(getattr(error, "response", None), "status_code", None)
    if status in (401, 403):
        return (
            f"{target}: the Hub refuses the token ({status}); use one that may write there: "
            "`hf auth login`"
        )
    return f"{target}: {reason(error)}; the same command goes on, and sends only missing files"


def publish(
    request: Request,
    *,
    dry_run: bool = False,
    private: bool = False,
    show_progress: bool = False,
    on_staged: Callable[[Staged], None] = lambda staged: None,
    **checking: Any,
) -> tuple[Staged, str | None]:
    """Verify a dataset, make its folder, and send it. No server is contacted before the folder is
    complete.

    Args:
        request: The request.
        dry_run: Only make the folder.
        private: Whether a new repository is private.
        show_progress: Whether the Hub's client shows its progress.
        on_staged: Called with the folder before it is sent.
        checking: Further arguments of `scenegen.verify`.

    Returns:
        The folder, and its commit on the Hub; None after a dry run.

    Raises:
        DatasetError: The dataset is damaged.
        PublishError: It fails a check, or cannot be published; or the Hub refuses.
    """
    from scenegen.verification import verify

    # before the samples are verified, which can take hours
    if not dry_run:
        check_token()
    examine(request)
    report = verify(request.dataset, kind=request.kind, **checking)
    if not report.ok:
        first = [f" {check.name}: {check.detail};" for check in report.checks if not check.ok][:1]
        raise PublishError(
            f"{request.dataset}: does not pass `scenegen verify`:{''.join(first)} nothing is "
            "published; generate it again"
        )
    staged = stage(
        request,
        tuple(
            (check.name, "not checked, " * check.skipped + check.detail) for check in report.checks
        ),
    )
    on_staged(staged)
    return staged, None if dry_run else upload(staged, private=private, show_progress=show_progress)
