"""The study's page says what its figures say, and what is said of it elsewhere stands in them."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from scenegen.model.reproduce.figures import draw
from scenegen.model.reproduce.report import to_markdown

DOCS = Path(__file__).parents[2] / "docs"
FIGURE = re.compile(r"(?<![\w.])[+-]?0?\.\d{3}(?!\d)")
"""Three decimals: how the text gives a figure of the study."""


@pytest.fixture(scope="module")
def study() -> Any:
    return json.loads((DOCS / "results" / "study.json").read_text(encoding="utf-8"))


def numbers(value: Any) -> Iterator[float]:
    """Every number in a tree."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        for one in value:
            yield from numbers(one)
    elif isinstance(value, float):
        yield value


def test_the_page_is_made_of_the_figures(study: Any) -> None:
    assert (DOCS / "results" / "study.md").read_text(encoding="utf-8") == to_markdown(study)


def test_every_figure_in_the_text_is_one_of_the_study(study: Any) -> None:
    text = (DOCS / "study.md").read_text(encoding="utf-8").partition("## What it found")[2].partition("\n## ")[0]
    said = {f"{abs(float(figure)):.3f}" for figure in FIGURE.findall(text)}
    assert said
    there = {f"{abs(number):.3f}" for number in numbers(study)}
    assert said <= there, sorted(said - there)


def test_every_claim_has_what_its_verdict_rests_on(study: Any) -> None:
    """Confirmed and refuted need two seeds, whose intervals lie on one side; each network says how it was made."""
    for claim in study["claims"] + study["beside"]:
        sides = {(one["low"] > 0) - (one["high"] < 0) for one in claim["seeds"]}
        decided = len(claim["seeds"]) >= 2 and sides in ({1}, {-1})
        assert claim["verdict"] == ({1: "confirmed", -1: "refuted"}[sides.pop()] if decided else "undecided")
    for run in study["runs"].values():
        assert run["hours"] > 0
        assert run["command"]
        assert run["device"]
        assert re.fullmatch(r"[0-9a-f]{64}", run["sha256"])


def test_the_figures_can_be_drawn_again(study: Any) -> None:
    pytest.importorskip("matplotlib")
    assert {"claims.png", "learning.png", "reliability.png"} <= draw(study).keys()
