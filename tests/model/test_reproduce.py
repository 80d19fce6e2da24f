"""The study from a seed to its report: what is refused, what is kept, and, on request, all of it at
1/200."""

import json

import pytest
import torch

from scenegen.errors import DatasetError
from scenegen.model.checkpoint import load_tensors
from scenegen.model.study.claims import to_markdown
from scenegen.model.study.runs import RUNS, ReproduceConfig, chosen
from scenegen.model.study.steps import STUDY, TEXT, begin
from tests.command_line import done

JUDGED = ("verdicts", "claims", "beside", "paths", "means")


def test_runs_differ_in_what_they_are_for():
    """Names are unique, settings pairwise different, and verdicts have two seeds at least."""
    names = {run.name for run in RUNS}
    assert len(names) == len({repr((run.settings, run.seed)) for run in RUNS}) == len(RUNS)
    assert {name.rpartition("-s")[0] + "-s1" for name in names} <= names


def test_a_study_goes_on_with_its_own_settings_alone(tmp_path):
    begin(tmp_path / "study", ReproduceConfig(scale=0.5))
    begin(tmp_path / "study", ReproduceConfig(scale=0.5))
    with pytest.raises(DatasetError, match=r"other settings \(scale is 0.5 there, 1.0 asked for\)"):
        begin(tmp_path / "study", ReproduceConfig())
    (tmp_path / "file").touch()
    with pytest.raises(DatasetError, match="file"):
        begin(tmp_path / "file" / "study", ReproduceConfig())
    with pytest.raises(DatasetError, match="--only occ: no such run; known are occ-s0, "):
        chosen(("occ",))


@pytest.mark.slow
def test_a_small_part_of_the_study_is_made_and_goes_on_where_it_was(capsys, tmp_path):
    """All of it by the command; then what is damaged is made again, and all else is kept."""
    out = tmp_path / "study"
    only = [run.name for run in RUNS if run.name[:-3] in ("occ", "columns")][:4]
    words = ["reproduce", "--scale", "0.005", "--device", "cpu", "--out", out, "--quiet"]
    words += [word for name in only for word in ("--only", name)]
    done(capsys, *words)
    first = json.loads((out / STUDY).read_text())
    assert list(first["runs"]) == only
    assert (out / TEXT).read_text() == to_markdown(first)
    assert json.loads(done(capsys, "reproduce", "--from", out / STUDY, "--json")) == first
    held = {path: path.stat().st_mtime_ns for path in out.rglob("best.safetensors")}
    damaged = out / "runs" / "occ-s0" / "last.safetensors"
    best = damaged.with_name("best.safetensors")
    weights = load_tensors(best)[0]
    damaged.write_bytes(b"damaged")
    done(capsys, *words, "--on", "tests.scenegen.run.backwards:Backwards")
    again = json.loads((out / STUDY).read_text())
    assert [again[part] for part in JUDGED] == [first[part] for part in JUDGED]
    assert {path for path in held if path.stat().st_mtime_ns != held[path]} == {best}
    assert all(torch.equal(weights[name], values) for name, values in load_tensors(best)[0].items())
