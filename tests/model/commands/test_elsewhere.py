"""What works shard by shard gives the same wherever it is done: `--on` for verify, convert, bench
and complete."""

import pytest

from tests.command_line import done, run
from tests.conftest import contents
from tests.refusals import refuses_command
from tests.scenegen.base import everywhere
from tests.scenegen.base.backwards import die_of_one
from tests.scenegen.base.everywhere import SAMPLES, checks

AWAY = ("--on", "tests.scenegen.base.backwards:Backwards")
CUT_OFF = (*AWAY[:1], f"{AWAY[1]}://1")
"""The second task is lost."""
CONVERT = ("convert", "d", "--to", "webdataset")
RANKS = 3


@pytest.fixture
def here(once, tmp_path, monkeypatch, undrawn):
    """A folder to stand in, with a dataset and a network."""
    made = once("everywhere", everywhere.make)
    for name in ("d", "n.safetensors"):
        (tmp_path / name).symlink_to(made / name)
    everywhere.stand(tmp_path, monkeypatch)
    return tmp_path


def as_ranks(capsys, monkeypatch, *words):
    """What each of several ranks says, the last one first."""
    monkeypatch.setenv("SCENEGEN_WORLD_SIZE", str(RANKS))
    for rank in reversed(range(RANKS)):
        monkeypatch.setenv("SCENEGEN_RANK", str(rank))
        yield run(capsys, *words, "--on", "rank", "--workers", 1)


def test_ranks_verify_every_sample_once(here, capsys, monkeypatch):
    """Together; they skip what compares all shards."""
    words = ("verify", "d", "--json")
    whole = checks(done(capsys, *words, "--workers", 1))
    parts = [checks(said) for _, said, _ in as_ranks(capsys, monkeypatch, *words)]
    del whole["manifest"]["counts"]["files"]
    for name, check in whole.items():
        for counted in check["counts"].keys() - {"compared"}:
            total = sum(part[name]["counts"].get(counted, 0) for part in parts)
            assert total in (check["counts"][counted], 0), (name, counted)
    assert parts[0]["splits"]["skipped"]
    assert not parts[0]["checksums"]["skipped"]


def test_verify_names_the_file_that_crashes_its_process(here, capsys, monkeypatch):
    """Also where an executor calls the function in a process of its own: that lives on, and so does
    the next task."""
    monkeypatch.setattr("scenegen.verification.folder.examine", die_of_one)
    code, said, _ = run(capsys, "verify", "d", "--json", "--quick", *AWAY)
    examined = checks(said)["examined"]
    assert code == 1
    assert examined["faults"] == 1
    assert examined["counts"] == {"shards": 5}
    assert "test-00001.h5" in examined["detail"]
    assert "ended its process: it crashed" in examined["detail"]


@pytest.mark.parametrize("words", [CONVERT, everywhere.COMPLETE], ids="/".join)
def test_ranks_fill_and_runs_go_on(here, capsys, monkeypatch, words):
    """One folder; after a run that lost a task."""
    whole = done(capsys, *words, "-o", "whole", "--workers", 2)
    refuses_command(capsys, " ".join((*words, "-o again --quiet", *CUT_OFF)))
    again = done(capsys, *words, "-o", "again")
    ranks = list(as_ranks(capsys, monkeypatch, *words, "-o", "ranks"))
    assert contents(here / "ranks") == contents(here / "again") == contents(here / "whole")
    if words is CONVERT:
        assert whole == f"whole: {SAMPLES} samples written\n"
        assert "; an earlier run wrote " in again
        assert all("are for the other ranks to write there" in said for _, said, _ in ranks)


def test_scans_are_completed_here(here, capsys):
    (here / "scan.xyz").write_text("1 1 1\n")
    refuses_command(capsys, f"complete scan.xyz --weights n.safetensors {' '.join(AWAY)}")


def test_ranks_that_share_nothing_are_refused(here, capsys, monkeypatch):
    """They say so before any work."""
    words = (*everywhere.BENCH, "-o", "ranks", "--quiet")
    for code, _, complaint in as_ranks(capsys, monkeypatch, *words):
        assert code == 1
        assert complaint.count("\n") == 1
        assert "give --on ray" in complaint
    assert not (here / "ranks").exists()
