"""The tutorial: its command lines parse, its pictures are there, its notebook is the script's;
slow: all of it runs."""

import json
import runpy
import shlex
from types import SimpleNamespace

import pytest

from scenegen.__main__ import app
from tests.command_line import ROOT

DOCS = ROOT / "docs"
MAX_BYTES = 1_200_000
"""Of the notebook, pictures included."""

tutorial = SimpleNamespace(**runpy.run_path(str(DOCS / "tutorial.py")))
PAGE = tutorial.PAGE.read_text(encoding="utf-8")


@pytest.mark.parametrize("words", tutorial.commands(PAGE), ids=shlex.join)
def test_every_command_line_parses(words):
    program, name, *rest = words
    assert program == "scenegen"
    command = app.registry.find(name)
    assert command.make_context(name, list(rest)).params


def test_every_picture_is_there_and_is_shown():
    shown = tutorial.PICTURE.findall(PAGE)
    made = {word for words in tutorial.commands(PAGE) for word in words}
    assert sorted(shown) == sorted(path.name for path in (DOCS / tutorial.PICTURES).iterdir())
    assert set(shown) <= made


def test_the_notebook_is_the_page():
    text = tutorial.NOTEBOOK.read_text(encoding="utf-8")
    assert text == tutorial.written(PAGE), "run python docs/tutorial.py"
    assert len(text.encode()) < MAX_BYTES
    cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
    assert all(cell["outputs"] for cell in cells[1:])  # the first sets up
    pictures = [output["data"] for cell in cells for output in cell["outputs"] if "data" in output]
    assert [[*data] for data in pictures] == len(pictures) * [["image/png", "text/plain"]]
    assert not any(word in text for word in ("<iframe", "<script", "\\u001b"))


def test_blocks_run_in_order_in_the_folder_and_their_outputs_stand_in_the_page(
    tmp_path,
):
    blocks = {
        "sh": "echo 3 > n",
        "python": "n = int(open('n').read())\n\nprint(2 * n)",
        "text": "?",
    }
    page = "".join(f"```{kind}\n{text}\n```\n" for kind, text in blocks.items())
    said, outputs = tutorial.run(page, tmp_path)
    assert said == page.replace("?", "6")
    assert len(outputs) == 3  # with the one that sets up


@pytest.mark.slow
def test_the_whole_page_runs_in_an_empty_folder(tmp_path):
    """Five minutes of two cores."""
    said, outputs = tutorial.run(PAGE, tmp_path)
    assert tutorial.commands(said) == tutorial.commands(PAGE)
    for name in tutorial.PICTURE.findall(PAGE):
        assert (tmp_path / name).stat().st_size > 1000
        assert "image/png" in outputs[f'Image("{name}")'][0]["data"]
    assert "image/png" in outputs["scenegen.show(sample)"][0]["data"]
