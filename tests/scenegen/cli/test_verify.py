"""`scenegen verify` as users meet it."""

import json
import os

from tests.command_line import done, run
from tests.conftest import dataset_in
from tests.refusals import refuses_command


def test_verify_prints_a_table_and_ends_with_one_where_a_check_fails(tmp_path, capsys):
    folder = dataset_in(tmp_path / "d").folder
    table = done(capsys, f"verify {folder} --workers 1")
    assert [line.split()[1] for line in table.splitlines() if line][:-2] == ["ok"] * 20
    for line in ("3 samples, 0 pairs alike enough to compare", "1 file, 3 samples"):
        assert f"s  {line}\n" in table
    assert "3 samples in" in table
    assert "all 20 checks passed" in table
    shard, failing = folder / "train-00000.h5", ["checksums", "layout", "digest"]
    os.truncate(shard, shard.stat().st_size - 9_000)
    line = f"scenegen: verify: 3 of 13 checks failed: {', '.join(failing)}\n"
    assert run(capsys, f"verify {folder} --quick --quiet") == (1, "", line)
    code, text, _ = run(capsys, f"verify {folder} --json --quick")
    report = json.loads(text)
    facts = report["ok"], report["quick"], report["failed"]
    assert (code, *facts) == (1, False, True, failing)
    skipped = [check["name"] for check in report["checks"] if check["skipped"]]
    assert skipped == ["names", "centred", "laws", "duplicates", "flights", "accepted"]
    refuses_command(capsys, f"verify {tmp_path}/absent")
