"""The study from a seed to its report: what is refused, what is kept, and, on request, all of it at
1/200."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch

from scenegen.errors import DatasetError
from scenegen.model.checkpoint import load_tensors
from scenegen.model.reproduce import stages
from scenegen.model.reproduce.config import ReproduceConfig
from scenegen.model.reproduce.report import to_markdown
from scenegen.model.reproduce.rows import estimate
from scenegen.model.reproduce.runs import ELSEWHERE, KINDS, LEAST_SEEDS, RUNS, SEEDS
from scenegen.model.reproduce.stages import RECORDS, STUDY, TEXT, begin, runs
from scenegen.recipe import preset
from tests.command_line import run as command

JUDGED = ("verdicts", "claims", "beside", "paths", "contrasts")


def test_runs_differ_in_what_they_are_for() -> None:
    """Names are unique, settings are possible and pairwise different, and verdicts have their
    seeds."""
    assert len({run.name for run in RUNS}) == len(RUNS)
    configs = [run.config(20_000) for run in RUNS]
    assert len(
        {(repr(one), run.samples, run.worlds) for one, run in zip(configs, RUNS, strict=True)}
    ) == len(RUNS)
    for name in ("occ", "tudf", "proposed"):
        assert {f"{name}-s{seed}" for seed in range(SEEDS.get(name, LEAST_SEEDS))} <= {
            run.name for run in RUNS
        }
    assert {config.maps for config in configs} == {20_000, 5_000}
    named = {run.name: run for run in RUNS}
    for run in RUNS:
        if run.against is not None:
            other = named[run.against]
            assert (run.share, run.seed, run.worlds) == (other.share, other.seed, other.worlds)
            changed = ("network", "loss", "protocol", "samples")
            assert sum(getattr(run, name) != getattr(other, name) for name in changed) == 1


@pytest.mark.parametrize("kind", KINDS)
def test_half_as_many_obstacles_are_half_of_the_presets(kind: str) -> None:
    assert 2 * np.array(ELSEWHERE["sparse"].tables[kind]["world"]["density"]) == pytest.approx(
        preset(kind).world.density
    )


def test_a_study_goes_on_with_its_own_settings_alone(tmp_path: Path) -> None:
    begin(tmp_path / "study", ReproduceConfig(scale=0.5))
    begin(tmp_path / "study", ReproduceConfig(scale=0.5, only=("occ-s0",)))
    with pytest.raises(
        DatasetError, match=r"begun with other settings \(scale is 0.5 there, 1.0 asked for\)"
    ):
        begin(tmp_path / "study", ReproduceConfig())
    (tmp_path / "file").touch()
    with pytest.raises(DatasetError, match="file"):
        begin(tmp_path / "file" / "study", ReproduceConfig())
    with pytest.raises(DatasetError, match="--only occ: no such run; known are occ-s0, "):
        runs(ReproduceConfig(only=("occ",)))


def test_estimates_grow_with_what_is_to_be_done(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "scenegen.model.reproduce.rows._map_seconds", lambda device: 0.1
    )  # it takes seconds
    small, large = (
        estimate(config, runs(config), device="cpu", workers=2)
        for config in (ReproduceConfig(scale=0.02, only=("occ-s0",)), ReproduceConfig(scale=0.02))
    )
    assert small.train_s == pytest.approx(400 * 0.1 / 2)
    assert large.train_s == pytest.approx(sum(run.share for run in RUNS) * small.train_s)
    assert large.generate_s == pytest.approx((1 + len(ELSEWHERE)) * small.generate_s)
    assert large.bench_s > small.bench_s
    assert large.bytes > small.bytes
    assert set(large.words()) == {"time", "disk", "on"}


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
    assert {part: first[part] for part in JUDGED} == json.loads(text)
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
    run, config = runs(ReproduceConfig(only=("occ-s0",)))[0], ReproduceConfig(scale=0.01)
    settings = json.loads(json.dumps(asdict(run.config(200))))
    for name in ("inputs", "height"):
        del settings["network"][name]
    (tmp_path / "config.json").write_text(
        json.dumps({"settings": settings | {"samples": 50, "precision": "bfloat16"}})
    )
    assert not stages._complete(tmp_path, run, config)
    heads = "epoch,maps,train_loss,val_loss,val_iou,val_near_mae"
    for maps, whole in ((160, False), (200, True)):
        (tmp_path / "metrics.csv").write_text(f"{heads}\n1,80,1,1,0,1\n2,{maps},1,1,0,1\n")
        assert stages._complete(tmp_path, run, config) == whole
    assert not stages._complete(tmp_path, run, ReproduceConfig(scale=0.02))
    assert not stages._complete(tmp_path, runs(ReproduceConfig(only=("occ-s1",)))[0], config)
