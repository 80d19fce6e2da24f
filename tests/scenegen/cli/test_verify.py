"""`scenegen verify` as users meet it."""

import json

from tests.command_line import run
from tests.scenegen.verification import forge


def test_verify_prints_a_table_and_ends_with_one_where_a_check_fails(tmp_path, capsys):
    folder = forge.make(tmp_path / "d", counts={"train": 3, "val": 0, "test": 0})
    code, said, complaint = run(capsys, f"verify {folder} --workers 1")
    assert code == 0
    assert [line.split()[1] for line in said.splitlines() if line][:-2] == ["ok"] * 17
    assert "3 samples in" in said
    assert "all 17 checks passed" in said
    assert "scenegen:" not in complaint
    code, said, _ = run(capsys, f"verify {folder} --quick --json")
    report = json.loads(said)
    assert (code, report["ok"], report["quick"], len(report["checks"])) == (0, True, True, 10)
    (folder / "train-00000.h5").write_bytes((folder / "train-00000.h5").read_bytes()[:-9_000])
    code, said, complaint = run(capsys, f"verify {folder} --quick --quiet")
    assert (code, said) == (1, "")
    assert complaint == "scenegen: verify: 3 of 10 checks failed: checksums, layout, digest\n"
    code, said, _ = run(capsys, f"verify {folder} --json --quick")
    report = json.loads(said)
    assert (code, report["failed"]) == (1, ["checksums", "layout", "digest"])
    left = [check["name"] for check in report["checks"] if check["skipped"]]
    assert left == ["names", "centred", "laws"]
    code, said, complaint = run(capsys, "verify", tmp_path / "nowhere")
    assert (code, said) == (1, "")
    assert "not a dataset, there is no such folder" in complaint
