"""The study from a seed to its report: what is refused, what is kept, and, on request, all of it at
1/200."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch

from scenegen.errors import DatasetError
from scenegen.model.checkpoint import load_tensors
from scenegen.model.study.report import to_markdown
from scenegen.model.study.runs import LEAST_SEEDS, RUNS, SEEDS, ReproduceConfig
from scenegen.model.study.stages import RECORDS, STUDY, TEXT, Study
from tests.command_line import run as command

JUDGED = ("verdicts", "claims", "beside", "paths", "contrasts", "means")


def study(folder: Path, scale: float = 1.0, *only: str) -> Study:
    return Study(out=folder, config=ReproduceConfig(scale=scale, only=only))


def test_runs_differ_in_what_they_are_for() -> None:
    """Names are unique, settings are possible and pairwise different, and verdicts have their
    seeds."""
    names = {run.name for run in RUNS}
    assert len(names) == len({repr(run.config(20_000)) for run in RUNS}) == len(RUNS)
    for name in ("occ", "tudf", "proposed"):
        assert {f"{name}-s{seed}" for seed in range(SEEDS.get(name, LEAST_SEEDS))} <= names


def test_a_study_goes_on_with_its_own_settings_alone(tmp_path: Path) -> None:
    study(tmp_path / "study", 0.5).begin()
    study(tmp_path / "study", 0.5, "occ-s0").begin()
    with pytest.raises(DatasetError, match=r"other settings \(scale is 0.5 there, 1.0 asked for\)"):
        study(tmp_path / "study").begin()
    (tmp_path / "file").touch()
    with pytest.raises(DatasetError, match="file"):
        study(tmp_path / "file" / "study").begin()
    with pytest.raises(DatasetError, match="--only occ: no such run; known are occ-s0, "):
        study(tmp_path, 1.0, "occ").chosen()


def test_what_a_study_takes_grows_with_its_runs(tmp_path: Path) -> None:
    assert study(tmp_path, 0.02, "occ-s0").takes() == {
        "datasets": "130 samples",
        "networks": "1, 400 maps of training in all",
        "bench": "40 trials a kind and network",
    }
    assert f"{len(RUNS)}, {len(RUNS) * 400} maps" in study(tmp_path, 0.02).takes()["networks"]


@pytest.mark.slow
def test_a_small_part_of_the_study_is_made_and_goes_on_where_it_was(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """All of it by the command; then what is damaged is made again, and all else is kept."""
    out = tmp_path / "study"
    words = ["reproduce", "--scale", "0.005", "--device", "cpu", "--out", out, "--quiet"]
    assert command(capsys, *words)[0] == 0
    first = json.loads((out / STUDY).read_text())
    assert set(first["runs"]) == {run.name for run in RUNS}
    assert (out / TEXT).read_text() == to_markdown(first)
    assert {said["verdict"] for said in first["verdicts"].values()} <= {
        "confirmed",
        "contradicted",
        "undecided",
    }
    code, text, _ = command(capsys, "reproduce", "--from", out / RECORDS, "--json")
    assert code == 0
    assert {part: first[part] for part in JUDGED} == {
        part: json.loads(text)[part] for part in JUDGED
    }
    assert (out / RECORDS).stat().st_size < 3e6 * 0.02 + 1e5
    held = {path: path.stat().st_mtime_ns for path in out.rglob("best.safetensors")}
    damaged = out / "runs" / "occ-s0" / "best.safetensors"
    weights = load_tensors(damaged)[0]
    damaged.write_bytes(b"damaged")
    bench = out / "bench" / "pillar" / "columns-s0.npz"
    bench.write_bytes(bench.read_bytes()[:-100])
    assert command(capsys, *words)[0] == 0
    again = json.loads((out / STUDY).read_text())
    assert [again[part] for part in JUDGED] == [first[part] for part in JUDGED]
    assert {path for path in held if path.stat().st_mtime_ns != held[path]} == {damaged}
    assert all(
        torch.equal(weights[name], values) for name, values in load_tensors(damaged)[0].items()
    )


def test_a_run_counts_as_complete_by_its_settings_and_its_last_map(tmp_path: Path) -> None:
    """Runs of earlier commits name neither inputs nor height."""
    asked = study(tmp_path, 0.01, "occ-s0")
    (run,) = asked.chosen()
    folder = tmp_path / "runs" / run.name
    folder.mkdir(parents=True)
    settings = json.loads(json.dumps(asdict(run.config(200))))
    for name in ("inputs", "height"):
        del settings["network"][name]
    (folder / "config.json").write_text(
        json.dumps({"settings": settings | {"samples": 50, "precision": "bfloat16"}})
    )
    assert not asked.complete(run)
    heads = "epoch,maps,train_loss,val_loss,val_iou,val_near_mae"
    for maps, whole in ((160, False), (200, True)):
        (folder / "metrics.csv").write_text(f"{heads}\n1,80,1,1,0,1\n2,{maps},1,1,0,1\n")
        assert asked.complete(run) == whole
    assert not study(tmp_path, 0.02).complete(run)
    assert not asked.complete(replace(run, seed=1))
