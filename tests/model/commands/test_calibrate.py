"""`scenegen calibrate` as users meet it: bad use ends in one line, and writes nothing."""

from tests.command_line import run


def test_bad_use_ends_in_one_line(tmp_path, monkeypatch, capsys, folders):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "net.onnx").write_bytes(b"")
    for words, code, told in (
        (("net.onnx", folders[0]), 1, "calibrate its .safetensors file, then export"),
        (("proposed", folders[0]), 1, "completes maps on"),
        (("proposed", folders[0], "--trials", "-1"), 2, "--trials"),
    ):
        found, _, said = run(capsys, "calibrate", *words, "--workers", 1, "--quiet")
        assert found == code
        assert told in said
        assert code == 2 or said.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["net.onnx"]
