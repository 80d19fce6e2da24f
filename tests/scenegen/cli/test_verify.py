"""`scenegen verify` as users meet it."""

import json
import os

from tests.command_line import done, refused, run
from tests.conftest import dataset_in


def test_verify_prints_a_table_and_ends_with_one_where_a_check_fails(tmp_path, capsys):
    folder = dataset_in(tmp_path / "d").folder
    said = done(capsys, f"verify {folder} --workers 1")
    assert [line.split()[1] for line in said.splitlines() if line][:-2] == ["ok"] * 20
    assert "s  3 samples, 0 pairs alike enough to compare\n" in said
    assert "s  1 file, 3 samples\n" in said
    assert ("3 samples in" in said, "all 20 checks passed" in said) == (True, True)
    report = json.loads(done(capsys, f"verify {folder} --quick --json"))
    assert (report["ok"], report["quick"], len(report["checks"])) == (True, True, 13)
    shard, failing = folder / "train-00000.h5", ["checksums", "layout", "digest"]
    os.truncate(shard, shard.stat().st_size - 9_000)
    told = f"scenegen: verify: 3 of 13 checks failed: {', '.join(failing)}\n"
    assert run(capsys, f"verify {folder} --quick --quiet") == (1, "", told)
    code, said, _ = run(capsys, f"verify {folder} --json --quick")
    report = json.loads(said)
    assert (code, report["failed"]) == (1, failing)
    left = [check["name"] for check in report["checks"] if check["skipped"]]
    assert left == ["names", "centred", "laws", "duplicates", "flights", "accepted"]
    assert "not a dataset, there is no such" in refused(capsys, f"verify {tmp_path}/nowhere")
