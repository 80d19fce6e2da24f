"""The study's page says what its figures say, and its verdicts follow from them."""

import json
import re
from pathlib import Path

import pytest

from benchmarks.paper.claims import PATIENCE, judged, to_markdown, waited

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="module")
def study():
    return json.loads((DOCS / "results" / "study.json").read_text(encoding="utf-8"))


def test_the_page_is_made_of_the_figures(study):
    assert (DOCS / "results" / "study.md").read_text(encoding="utf-8") == to_markdown(study)


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
