"""A run killed at any point leaves nothing half-written, and the same command finishes the same
dataset."""

import itertools
import multiprocessing
import os
import signal
import sys

import h5py
import pytest

from scenegen.dataset.build import build
from scenegen.dataset.shard import read_report
from tests.conftest import contents, picky_recipe, plan_of

COUNTS = {"train": 6, "val": 0, "test": 3}
SEED = 19
"""One at which every shard rejects at least one world and one viewpoint, and few more."""
CHANGES = ("os.mkdir", "os.rename", "os.remove")


def plan(folder):
    return plan_of(folder, picky_recipe(), seed=SEED, counts=COUNTS, shard_samples=6)


def build_and_die(folder, at):
    """Build, and be killed just before the change numbered `at` of what lies in the folder."""
    changes = itertools.count()

    def watch(event, words):
        written = event == "open" and words[2] & (os.O_WRONLY | os.O_RDWR)
        if (written or event in CHANGES) and str(folder) in str(words[0]) and next(changes) == at:
            os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(watch)
    build(plan(folder))


def killed(folder, at):
    run = multiprocessing.get_context("fork").Process(target=build_and_die, args=(folder, at))
    run.start()
    run.join()
    return {0: False, -signal.SIGKILL: True}[run.exitcode]


@pytest.mark.usefixtures("drawn_once")
def test_a_kill_before_any_change_of_a_file_changes_nothing(tmp_path):
    whole = plan(tmp_path / "whole")
    build(whole)
    for shard in whole.shards:
        rejected = read_report(whole.folder, (shard, None)).rejected
        assert min(counts.total() for counts in rejected.values()) > 0
    written = []
    while killed(folder := tmp_path / f"killed-{len(written)}", len(written)):
        for path in folder.glob("*.h5"):
            with h5py.File(path) as file:
                assert len(file["world"]) > 0
        written.append(build(plan(folder)).samples_written)
        assert contents(folder) == contents(whole.folder)
    assert len(written) >= 12  # six files, each begun and put in its place
    assert set(written) == {9, 3, 0}  # kills fell before, between and after the two shards
