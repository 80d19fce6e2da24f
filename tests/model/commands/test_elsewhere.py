"""What works shard by shard gives the same wherever it is done: `--on` for verify, convert, bench and complete."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from scenegen.dataset.read import Dataset
from scenegen.model.checkpoint import save_network
from scenegen.model.config import NetworkConfig
from scenegen.model.network import Network
from tests.command_line import SMALL, run
from tests.conftest import Once
from tests.scenegen.executors.backwards import die_of_one

AWAY = ("--on", "tests.scenegen.executors.backwards:Backwards")
CUT_OFF = (*AWAY[:1], f"{AWAY[1]}://1")
"""The second task is lost."""
RANKS = 3
Shell = pytest.CaptureFixture[str]


@pytest.fixture
def here(once: Once, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Shell) -> Path:
    """A folder to stand in: `d`, a dataset, and `n.safetensors`, a network for it."""

    def fill(folder: Path) -> None:
        (folder / "small.toml").write_text(SMALL)
        words = ("--n", 6, "--val", 4, "--test", 7, "--shard-samples", 3, "--workers", 1, "--out", folder / "d")
        assert run(capsys, "generate", "--recipe", folder / "small.toml", *words, "--quiet")[0] == 0
        torch.manual_seed(0)
        network = Network(NetworkConfig(width=2, height=16))
        save_network(folder / "n.safetensors", network, Dataset(folder / "d").grid, {})

    made = once("elsewhere", fill)
    for name in ("d", "n.safetensors"):
        (tmp_path / name).symlink_to(made / name)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("scenegen.view.exchange.convert.CHUNK", 2)
    monkeypatch.setattr("scenegen.model.evaluation.run.CHUNK", 2)
    monkeypatch.setattr("scenegen.model.completion.predictions.PART", 2)
    return tmp_path


def as_ranks(capsys: Shell, monkeypatch: pytest.MonkeyPatch, *words: object) -> list[tuple[int, str, str]]:
    """What each of several ranks says, the last one first."""
    monkeypatch.setenv("SCENEGEN_WORLD_SIZE", str(RANKS))
    found = []
    for rank in reversed(range(RANKS)):
        monkeypatch.setenv("SCENEGEN_RANK", str(rank))
        found.append(run(capsys, *words, "--on", "rank", "--workers", 1))
    return found


def files(folder: Path) -> dict[str, bytes]:
    """All files below a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def checks(said: str) -> dict[str, dict[str, Any]]:
    """A report's checks by name, without their time."""
    return {check.pop("name"): check | {"seconds": 0} for check in json.loads(said)["checks"]}


def test_verify(here: Path, capsys: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ranks examine every sample once, together, and skip what compares all shards."""
    words = ("verify", "d", "--json")
    code, said, _ = run(capsys, *words, "--workers", 1)
    assert code == 0
    whole = checks(said)
    code, said, _ = run(capsys, *words, *AWAY)
    assert (code, checks(said)) == (0, whole)
    parts = [checks(said) for code, said, _ in as_ranks(capsys, monkeypatch, *words) if code == 0]
    assert len(parts) == RANKS
    for name, check in whole.items():
        for what, count in check["counts"].items():
            if what != "compared" and not (name == "manifest" and what == "files"):
                assert sum(part[name]["counts"].get(what, 0) for part in parts) in (count, 0), (name, what)
        if parts[0][name]["skipped"]:
            assert "compares all 7 shards" in parts[0][name]["detail"]
    assert parts[0]["splits"]["skipped"]
    assert not parts[0]["checksums"]["skipped"]


def test_verify_names_the_file_that_crashes_its_process(
    here: Path, capsys: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where an executor calls the function in a process of its own: that lives on, and so does the next task."""
    monkeypatch.setattr("scenegen.verify.folder.examine", die_of_one)
    code, said, _ = run(capsys, "verify", "d", "--json", "--quick", *AWAY)
    examined = checks(said)["examined"]
    assert (code, examined["faults"], examined["counts"]) == (1, 1, {"shards": 7})
    assert "val-00001.h5" in examined["detail"]
    assert "ended its process: it crashed" in examined["detail"]


@pytest.mark.parametrize("to", ["npz", "webdataset"])
def test_convert(here: Path, capsys: Shell, monkeypatch: pytest.MonkeyPatch, to: str) -> None:
    """Ranks fill one folder; a run that lost a task goes on."""
    words = ("convert", "d", "--to", to)
    for out, more in (("whole", ("--workers", 1)), ("two", ("--workers", 2)), ("away", AWAY)):
        code, said, _ = run(capsys, *words, "-o", out, *more)
        assert (code, said) == (0, f"{out}: 17 samples written, 0 were there\n")
    said = [said for _, said, _ in as_ranks(capsys, monkeypatch, *words, "-o", "ranks")]
    assert all("are for the other ranks to write there" in one for one in said)
    code, _, complaint = run(capsys, *words, "-o", "again", "--quiet", *CUT_OFF)
    assert (code, complaint.count("\n")) == (1, 1)
    assert "samples" in complaint
    assert "lost with its node" in complaint
    code, said, _ = run(capsys, *words, "-o", "again")
    assert (code, ", 0 were there" in said) == (0, False)
    whole = files(here / "whole")
    for out in ("two", "away", "ranks", "again"):
        assert files(here / out) == whole


def test_complete(here: Path, capsys: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same file, on one thread; whichever rank finds all parts joins them; parts of a lost run are kept."""
    words = ("complete", "d", "--weights", "n.safetensors", "--batch", 2, "--device", "cpu")
    assert run(capsys, *words, "-o", "whole.h5")[:2] == (0, "written: whole.h5\n")
    assert run(capsys, *words, "-o", "away.h5", *AWAY)[:2] == (0, "written: away.h5\n")
    said = [said for _, said, _ in as_ranks(capsys, monkeypatch, *words, "-o", "ranks.h5")]
    assert [one.partition(" ")[0] for one in said] == ["5", "3", "written:"]
    code, _, complaint = run(capsys, *words, "-o", "again.h5", "--quiet", *CUT_OFF)
    assert (code, complaint.count("\n")) == (1, 1)
    (kept,) = (path for path in here.glob("again.h5.*/*") if path.suffix == ".h5")
    before = kept.stat().st_mtime_ns
    code, _, _ = run(capsys, *words, "-o", "again.h5", "--quiet", *CUT_OFF)
    assert (code, kept.stat().st_mtime_ns) == (1, before)
    assert run(capsys, *words, "-o", "again.h5", *AWAY)[0] == 0
    whole = (here / "whole.h5").read_bytes()
    for out in ("away.h5", "ranks.h5", "again.h5"):
        assert (here / out).read_bytes() == whole
        assert not list(here.glob(f"{out}.*")), "parts are removed once they are joined"
    (here / "scan.xyz").write_text("1 1 1\n")
    code, _, complaint = run(capsys, "complete", "scan.xyz", "--weights", "n.safetensors", *AWAY)
    assert (code, complaint.count("\n")) == (1, 1)
    assert "complete a dataset's split" in complaint


def test_bench(here: Path, capsys: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same report; ranks cannot bring a report together, and say so before any work."""
    words = ("bench", "d", "--quick", "--weights", "n.safetensors", "--method", "returns", "--method", "truth")
    assert run(capsys, *words, "--workers", 1, "-o", "whole")[0] == 0
    assert run(capsys, *words, *AWAY, "-o", "away")[0] == 0
    reports = [json.loads((here / out / "report.json").read_text()) for out in ("whole", "away")]
    assert len({report.pop("command") for report in reports}) == 2
    assert reports[0] == reports[1]
    for code, _, complaint in as_ranks(capsys, monkeypatch, *words, "-o", "ranks", "--quiet"):
        assert (code, complaint.count("\n")) == (1, 1)
        assert "give --on ray or --on slurm" in complaint
    assert not (here / "ranks").exists()
