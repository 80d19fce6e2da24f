"""Which datasets a command takes where none is named."""

from pathlib import Path

import pytest

from scenegen.cli.options import find_datasets
from tests.command_line import run


def test_folders_under_data_without_samples_are_left_out(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from scenegen.dataset import manifest

    monkeypatch.chdir(tmp_path)
    assert run(capsys, "generate", "--recipe", small, "--n", 3, "--workers", 1, "--quiet")[0] == 0
    empty = manifest.read(Path("data/pillar"))
    Path("data/begun").mkdir()
    manifest.write(Path("data/begun"), {**empty, "shards": [], "complete": False, "digest": None})
    assert find_datasets((), shown=True) == (Path("data/pillar"),)
    assert capsys.readouterr().err == "data/begun: holds no samples yet, so it is left out\n"
