"""The study's page says what its figures say, and what is said of it elsewhere stands in them."""

import json
import re
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from scenegen.model.evaluation.metrics import METRICS, PLAN_METRICS
from scenegen.model.study.claims import PATIENCE, decided, seeded, spread, waited
from scenegen.model.study.report import to_markdown

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="module")
def study() -> Any:
    return json.loads((DOCS / "results" / "study.json").read_text(encoding="utf-8"))


def test_the_page_is_made_of_the_figures(study: Any) -> None:
    assert (DOCS / "results" / "study.md").read_text(encoding="utf-8") == to_markdown(study)


def test_every_claim_has_what_its_verdict_rests_on(study: Any) -> None:
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


def test_verdicts_follow_from_the_figures_of_the_file(study: Any) -> None:
    """From the means of all networks and the claims' errors over worlds."""
    spreads = {}
    for kind, metric in product(study["worlds"], METRICS | PLAN_METRICS):
        rows = study["means"][""][kind]
        better = (METRICS | PLAN_METRICS)[metric].better
        figures = {
            name: row[metric]["mean"] for name, row in rows.items() if seeded(name)[1] is not None
        }
        spreads[kind, metric] = spread(
            {n: abs(v) if better == "nearer to 0" else v for n, v in figures.items()}
        )
    for part in ("claims", "beside", "paths"):
        again = decided(study[part], spreads, ())
        assert [one["verdict"] for one in again] == [one["verdict"] for one in study[part]]
        assert [one["low"] for one in again] == pytest.approx(
            [one["low"] for one in study[part]], abs=1e-4
        )
