"""A run killed at any point leaves nothing half-written, and the same command finishes the same
dataset."""

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]


def test_a_kill_between_any_two_file_operations_changes_nothing(tmp_path):
    ran = subprocess.run(
        [sys.executable, "-m", "tests.scenegen.dataset.crash", str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr[-2000:]
    found = json.loads(ran.stdout)
    assert found["every_shard_rejects"]
    assert found["digest"]
    kills = found["kills"]
    assert len(kills) >= 36, "six files, at least six operations each"
    assert {kill["digest"] for kill in kills} == {found["digest"]}
    assert all(
        kill["same_manifest"] and kill["whole_files"] and kill["left"] == [] for kill in kills
    )
    assert len({kill["written"] for kill in kills}) == 3, (
        "kills fell before, between and after the two shards"
    )
