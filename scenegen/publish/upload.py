"""Publish: verify, stage, and send to the Hugging Face Hub: all files, then a look at what arrived,
and the tag.
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
"""Files that another dataset of ours may have left in the repository; others there are let be."""
IN_COMMIT = 250
"""The most files of a commit, about as many as the Hub's client begins with: the Hub gives up on
commits that take a minute."""
TOKEN = (
    "no token for the Hub: run `hf auth login`, or set HF_TOKEN, with one that may write; "
    "it is never an argument"
)


def check_token() -> None:
    """Raise PublishError where the Hub's client finds no token in its usual places, or is not
    installed."""
    try:
        from huggingface_hub import get_token
    except ImportError:
        raise PublishError(f"publishing {needs('huggingface_hub', 'publish')}") from None
    if not get_token():
        raise PublishError(TOKEN)


def upload(staged: Staged, *, private: bool, shown: bool) -> str:
    """Send the folder and return the commit that the tag names.

    Given again after an interruption it goes on: what the Hub has is not sent. A tag that is there
    already is left alone, and is in order where it names the same files. `shown`: the client shows
    its progress. Raises PublishError.
    """
    from huggingface_hub import HfApi

    api = HfApi(library_name="scenegen", library_version=__version__)
    try:
        with client_output(shown):
            return _send(api, staged, private)
    except ScenegenError:
        raise
    except Exception as error:  # whatever the Hub's client or the network beneath it raises
        raise PublishError(_explain(staged, error)) from None


def _send(api: Any, staged: Staged, private: bool) -> str:
    from huggingface_hub import CommitOperationAdd, CommitOperationDelete

    repository, target = staged.repository, f"hf://{staged.repository}"
    where = {"repo_id": repository, "repo_type": "dataset"}
    api.create_repo(**where, private=private or None, exist_ok=True)
    about = api.dataset_info(repository)
    if private and not about.private:
        raise PublishError(
            f"{target}: is there and public; leave --private out, or choose another --repo"
        )
    tags = {ref.name: ref.target_commit for ref in api.list_repo_refs(**where).tags}
    if staged.tag in tags:
        if wrong := differences(api, staged, tags[staged.tag]):
            raise PublishError(
                f"{target}: tag {staged.tag} is there with other content ({wrong[0]}); give "
                "another --tag"
            )
        return str(tags[staged.tag])
    former = [
        path
        for path in api.list_repo_files(**where)
        if OURS.fullmatch(path) and path not in staged.files
    ]
    head = about.sha
    # shards come first: the manifest and the card of a former dataset stand as long as they can
    names = sorted(
        [*differences(api, staged, head), *former], key=lambda it: not OURS.fullmatch(it)
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
        ).oid  # refused where another publisher was faster, whose shards would be in the tag, too
    if wrong := differences(api, staged, head):
        raise PublishError(
            f"{target}: not everything arrived ({wrong[0]}); give the same command again to go on"
        )
    api.create_tag(**where, tag=staged.tag, revision=head)
    return str(head)


def differences(api: Any, staged: Staged, revision: str) -> list[str]:
    """Files of the folder that the repository does not have, or has otherwise, at a revision."""
    from huggingface_hub.utils.sha import git_hash

    tree = api.list_repo_tree(
        staged.repository, repo_type="dataset", recursive=True, revision=revision
    )
    there = {entry.path: entry for entry in tree if hasattr(entry, "blob_id")}
    sums = read_sums(staged.folder)

    def is_there(name: str) -> bool:
        entry, path = there.get(name), staged.folder / name
        if entry is None or entry.lfs is None:
            return entry is not None and entry.blob_id == git_hash(path.read_bytes())
        return bool(entry.lfs.sha256 == (sums.get(name) or file_sha256(path)))

    return [name for name in staged.files if not is_there(name)]


def _explain(staged: Staged, error: Exception) -> str:
    """One line on what went wrong, and what to do."""
    target = f"hf://{staged.repository}"
    status = getattr(getattr(error, "response", None), "status_code", None)
    if status in (401, 403):
        return (
            f"{target}: the Hub refuses the token ({status}); use one that may write there: "
            "`hf auth login`"
        )
    return (
        f"{target}: {reason(error)}; what arrived is kept, and the same command goes on from there"
    )


def publish(
    request: Request,
    *,
    dry_run: bool = False,
    private: bool = False,
    shown: bool = False,
    on_staged: Callable[[Staged], None] = lambda staged: None,
    **checking: Any,
) -> tuple[Staged, str | None]:
    """Verify the dataset, put the folder together, and send it unless this is a `dry_run`. Returns
    the folder, and the commit on the Hub; None after a dry run.

    `checking` says how `scenegen.verify` goes about it. No server is contacted before the folder is
    complete; a dry run contacts none. Raises DatasetError, PublishError.
    """
    from scenegen.verification import verify

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
        tuple((one.name, "not checked, " * one.skipped + one.detail) for one in report.checks),
    )
    on_staged(staged)
    return staged, None if dry_run else upload(staged, private=private, shown=shown)
