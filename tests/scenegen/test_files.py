"""Files are written whole or not at all, replace nothing but regular files, and are cleaned up by
their owner alone."""

import multiprocessing
import os
import stat
import time
from pathlib import Path

import pytest

from scenegen.base import files
from scenegen.base.errors import DatasetError
from scenegen.base.executors import undo_all
from scenegen.base.files import (
    check_target,
    draft_of,
    make_parent,
    real_path,
    remove_temp_files,
    whole,
    write_atomic,
)
from tests.refusals import refuses
from tests.scenegen.conftest import names


def test_what_is_written_stands_there_and_nothing_beside_it(tmp_path):
    for content in (b"first", b"second"):
        write_atomic(tmp_path / "a", content)
        assert (tmp_path / "a").read_bytes() == content
    with whole(tmp_path / "b") as draft:
        draft.write_bytes(b"by name")
        assert not (tmp_path / "b").exists()
    assert (tmp_path / "b").read_bytes() == b"by name"
    with pytest.raises(KeyError), whole(tmp_path / "a") as draft:  # noqa: PT012
        draft.write_bytes(b"half")
        raise KeyError
    assert (tmp_path / "a").read_bytes() == b"second"
    assert names(tmp_path) == {"a", "b"}
    make_parent(tmp_path / "c" / "d" / "e")
    write_atomic(tmp_path / "c" / "d" / "e", b"")
    refuses("a", make_parent, tmp_path / "a" / "x" / "y")


def test_only_regular_files_are_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "target").write_bytes(b"mine")
    (tmp_path / "link").symlink_to(tmp_path / "target")
    (tmp_path / "nowhere").symlink_to(tmp_path / "absent")

    def modes():
        return {path.name: path.lstat().st_mode for path in tmp_path.iterdir()}

    before = modes()
    for name in ("pipe", "folder", "link", "nowhere"):
        refuses(name, write_atomic, tmp_path / name, b"content")
        with pytest.raises(DatasetError), whole(tmp_path / name):
            raise AssertionError("work for nothing")
    refuses("/dev/null", check_target, Path("/dev/null"))
    assert modes() == before
    assert (tmp_path / "target").read_bytes() == b"mine"


def test_a_pipe_put_there_meanwhile_is_not_replaced_either(tmp_path):
    with pytest.raises(DatasetError), whole(tmp_path / "a"):
        os.mkfifo(tmp_path / "a")
    assert stat.S_ISFIFO((tmp_path / "a").lstat().st_mode)
    assert names(tmp_path) == {"a"}


def test_a_draft_is_never_somebody_elses_file(tmp_path, monkeypatch):
    assert len({draft_of(tmp_path / "a") for _ in range(100)}) == 100
    planted, victim = tmp_path / ".scenegen-guessed.tmp", tmp_path / "victim"
    victim.write_bytes(b"mine")
    planted.symlink_to(victim)
    monkeypatch.setattr(files, "draft_of", lambda path: planted)
    with pytest.raises(DatasetError):
        write_atomic(tmp_path / "a", b"content")
    assert planted.is_symlink()
    assert victim.read_bytes() == b"mine"
    monkeypatch.undo()
    with pytest.raises(DatasetError), whole(tmp_path / "a") as draft:  # noqa: PT012
        draft.unlink()
        draft.symlink_to(victim)
    assert victim.read_bytes() == b"mine"
    assert not (tmp_path / "a").exists()


def test_cleaning_takes_what_an_ended_process_left_and_nothing_else(tmp_path):
    """Among the rest are drafts as they were called once, of whatever age."""
    with multiprocessing.get_context("fork").Pool(1) as pool:  # a process that has ended by then
        gone, gone_folder, link = pool.map(draft_of, [tmp_path / "a"] * 3)
    gone.write_bytes(b"half")
    gone_folder.mkdir()
    (gone_folder / "within").write_bytes(b"half")
    link.symlink_to(tmp_path / "x.tmp")
    (tmp_path / ".work.tmp").mkdir()
    others = [".mine.tmp", ".notes.host-1.tmp", ".a.host-999999.former.tmp", "x.tmp"]
    others += [draft_of(tmp_path / "a").name, gone.name.replace(".tmp", "0.tmp")]  # this one lives
    for name in others:
        (tmp_path / name).touch()
    for name in (*others, ".work.tmp"):
        os.utime(tmp_path / name, (0, 0))
    remove_temp_files(tmp_path, "b")
    assert gone.exists()  # of another target
    remove_temp_files(tmp_path, "a")
    assert names(tmp_path) == {*others, link.name, ".work.tmp"}


def test_a_process_number_in_use_again_and_other_machines_are_told_apart(tmp_path, monkeypatch):
    def draft(name, value):
        with monkeypatch.context() as patch:
            patch.setattr(files, name, lambda *asked: value)
            path = draft_of(tmp_path / "a")
        path.touch()
        return path

    draft("_own_start", 12345)  # of a former process of this number
    elsewhere, long_ago = (draft("_machine", "0123456789ab") for _ in range(2))
    os.utime(long_ago, (time.time(), time.time() - files.STALE_S - 60))
    remove_temp_files(tmp_path)
    assert list(tmp_path.iterdir()) == [elsewhere]


def test_a_stop_removes_what_is_being_written(tmp_path):
    write_atomic(tmp_path / "a", b"whole")
    undo_all()
    assert names(tmp_path) == {"a"}
    with pytest.raises(DatasetError), whole(tmp_path / "a"):  # noqa: PT012
        undo_all()
        assert names(tmp_path) == {"a"}


def test_links_are_followed_unless_they_lead_in_a_circle(tmp_path):
    (tmp_path / "link").symlink_to("a")
    (tmp_path / "loop").symlink_to("loop")
    assert real_path(tmp_path / "link") == tmp_path.resolve() / "a"
    assert real_path(tmp_path / "loop").name == "loop"
