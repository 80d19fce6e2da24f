"""The study's table and page say what its figures say, and its verdicts follow from them."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from benchmarks.paper.claims import PATIENCE, to_csv, waited

METHODS = ("columns", "proposed-1", "proposed", "occ", "tudf")
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


def test_the_readme_compares_networks_after_equal_training(study):
    """Its figures are the means over seeds of runs that saw as many maps."""
    page = (DOCS.parent / "README.md").read_text(encoding="utf-8")
    part = page.split("## Networks after equal training")[1].split("\n## ")[0]
    rows = [line.strip("|").split("|")[2:] for line in part.splitlines() if line.startswith("| ")]
    for (weight, *cells), method in zip(rows[1:], METHODS, strict=True):
        names = [f"{method}-s{seed}" for seed in (0, 1)]
        runs = [study["runs"][name] for name in names]
        assert {run["maps"] for run in runs} == {20000}
        weights = {run["settings"]["loss"]["occupancy"] for run in runs}
        assert "–" in weight or weights == {float(weight.split(",")[0])}
        means = [
            np.mean([study["means"][kind][name][metric]["mean"] for name in names])
            for metric in ("iou", "success")
            for kind in ("geometric", "pillar")
        ]
        figures = [float(figure) for cell in cells for figure in cell.split("·")]
        assert figures == pytest.approx(means, abs=5.1e-4)
