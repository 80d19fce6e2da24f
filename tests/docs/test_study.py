"""The study's page says what its figures say, and what is said of it elsewhere stands in them."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from scenegen.model.reproduce.figures import claims, learning
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
    """What is decided has two seeds of each method, all pairs on one side; each network says how it was made."""
    for claim in study["claims"] + study["beside"]:
        sides = {one["difference"] > 0 for one in claim["pairs"]}
        assert (claim["verdict"] != "undecided") == (len(sides) == 1 and (claim["holm"] or 1) <= 0.05)
        if claim["verdict"] != "undecided":
            assert len(claim["pairs"]) >= 4
            assert sides == {claim["verdict"] == "confirmed"}
    for run in study["runs"].values():
        assert run["hours"] > 0
        assert run["command"]
        assert run["device"]
        assert re.fullmatch(r"[0-9a-f]{64}", run["sha256"])


def test_the_figures_can_be_drawn_again(study: Any) -> None:
    """Those of the bench are drawn by tests of the bench."""
    pytest.importorskip("matplotlib")
    for picture in (claims(study), learning(study)):
        assert picture is not None
        assert picture.startswith(b"\x89PNG")
