"""A run killed at any point leaves nothing half-written, and the same command finishes the same
dataset."""

import itertools
import multiprocessing
import os
import shutil
import signal
import sys

import h5py
import pytest

from scenegen.dataset.build import build
from scenegen.dataset.shard import read_report
from tests.conftest import contents, picky_recipe, plan_of

COUNTS = {"train": 6, "val": 0, "test": 3}
SEED, OTHER = 19, 5
"""The first is one at which every shard rejects at least one world and one viewpoint, and few
more."""
CHANGES = ("os.mkdir", "os.rename", "os.remove")


def plan(folder, seed=SEED):
    return plan_of(folder, picky_recipe(), seed=seed, counts=COUNTS, shard_samples=6)


def build_and_die(folder, at):
    """Build in place of what is there, and be killed just before the change numbered `at` of what
    lies in the folder."""
    changes = itertools.count()

    def watch(event, words):
        written = event == "open" and words[2] & (os.O_WRONLY | os.O_RDWR)
        if (written or event in CHANGES) and str(folder) in str(words[0]) and next(changes) == at:
            os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(watch)
    build(plan(folder), force=True)


def killed(folder, at):
    run = multiprocessing.get_context("fork").Process(target=build_and_die, args=(folder, at))
    run.start()
    run.join()
    return {0: False, -signal.SIGKILL: True}[run.exitcode]


@pytest.mark.usefixtures("drawn_once")
@pytest.mark.parametrize(("there", "step"), [(None, 1), (OTHER, 3)])
def test_a_kill_before_any_change_of_a_file_changes_nothing(there, step, tmp_path):
    """Where nothing is there, or a dataset that goes: the same command finishes what was begun, and
    another dataset takes its place by force."""
    whole = {seed: plan(tmp_path / f"{seed}", seed) for seed in (SEED, OTHER)}
    for each in whole.values():
        build(each)
    for shard in whole[SEED].shards:
        rejected = read_report(whole[SEED].folder, (shard, None)).rejected
        assert min(counts.total() for counts in rejected.values()) > 0
    written = []
    for at in itertools.count(step=step):
        folder, other = tmp_path / f"killed-{at}", tmp_path / f"other-{at}"
        if there:
            shutil.copytree(whole[there].folder, folder)
        if not killed(folder, at):
            break
        for path in folder.glob("*.h5"):
            with h5py.File(path) as file:
                assert len(file["world"]) > 0
        if folder.exists():
            shutil.copytree(folder, other)
        written.append(build(plan(folder), force=bool(there)).samples_written)
        assert contents(folder) == contents(whole[SEED].folder)
        build(plan(other, OTHER), force=True)
        assert contents(other) == contents(whole[OTHER].folder)
    assert step * len(written) >= 12  # six files, each begun and put in its place
    # kills fell before, between and after the two shards
    assert there or set(written) == {9, 3, 0}
