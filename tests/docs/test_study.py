"""The study's table and page say what its figures say, and its verdicts follow from them."""

import json
import re
from pathlib import Path

import pytest

from benchmarks.paper.claims import PATIENCE, judged, to_csv, waited

DOCS = Path(__file__).parents[2] / "docs"
VERDICTS = "confirmed", "contradicted", "undecided"


@pytest.fixture(scope="module")
def study():
    return json.loads((DOCS / "results" / "study.json").read_text(encoding="utf-8"))


def test_the_table_of_claims_is_made_of_the_figures(study):
    assert (DOCS / "results" / "study.csv").read_text(encoding="utf-8") == to_csv(study)


def test_the_page_counts_verdicts_as_the_figures_do(study):
    page = (DOCS / "results" / "findings.md").read_text(encoding="utf-8")
    for question, found in study["verdicts"].items():
        counts = (found["claims"].get(name, "") for name in VERDICTS)
        row = re.search(rf"^\| {question}: [^|]*\|[^|]*\|(.*)\|$", page, re.MULTILINE)
        assert [cell.strip() for cell in row[1].split("|")] == [str(count) for count in counts]


def test_every_claim_has_what_its_verdict_rests_on(study):
    """What is decided has two seeds of each method; what is refuted, networks that trained long
    enough; and each network says how it was made."""
    long = {name for name, run in study["runs"].items() if waited(run) >= PATIENCE}
    for claim in study["claims"] + study["beside"]:
        assert (claim["verdict"] != "undecided") == (claim["holm"] <= 0.05)
        if claim["verdict"] != "undecided":
            assert len(claim["pairs"]) >= 4
            assert (claim["difference"] > 0) == (claim["verdict"] == "confirmed")
            assert not claim["low"] <= 0 <= claim["high"]
        if claim["verdict"] == "refuted":
            assert {f"{claim['best']}-s{pair['best_seed']}" for pair in claim["pairs"]} <= long
    for run in study["runs"].values():
        assert run["hours"] > 0
        assert run["command"]
        assert run["device"]
        assert re.fullmatch(r"[0-9a-f]{64}", run["sha256"])


def test_verdicts_follow_from_the_figures_of_the_file(study):
    again = judged(study)
    assert again["verdicts"] == study["verdicts"]
    for part in ("claims", "beside", "paths"):
        for one, other in zip(again[part], study[part], strict=True):
            assert one["verdict"] == other["verdict"]
            assert one["low"] == pytest.approx(other["low"], abs=1e-4)


def test_the_readme_compares_networks_after_equal_training(study):
    """Its figures are the means over seeds of runs that saw as many maps."""
    page = (DOCS.parent / "README.md").read_text(encoding="utf-8")
    part = page.split("## Networks after equal training")[1].split("\n## ")[0]
    rows = [line.strip("|").split("|") for line in part.splitlines() if line.startswith("| ")]
    methods = ("columns", "proposed-1", "proposed", "occ", "tudf")
    for (_, _, weight, *cells), method in zip(rows[1:], methods, strict=True):
        runs = [f"{method}-s{seed}" for seed in (0, 1)]
        assert {study["runs"][run]["maps"] for run in runs} == {20000}
        if "–" not in weight:
            learned = {study["runs"][run]["settings"]["loss"]["occupancy"] for run in runs}
            assert learned == {float(weight.split(",")[0])}
        for metric, cell in zip(("iou", "success"), cells, strict=True):
            for kind, figure in zip(("geometric", "pillar"), cell.split("·"), strict=True):
                means = [study["means"][kind][run][metric]["mean"] for run in runs]
                assert float(figure) == pytest.approx(sum(means) / 2, abs=0.00051)
