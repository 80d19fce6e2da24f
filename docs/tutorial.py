"""Write the notebook of the tutorial from its page, or run it.

    python docs/tutorial.py          # writes docs/tutorial.ipynb; cells keep their outputs
    python docs/tutorial.py --check  # ends with 1 where the notebook is not what would be written
    python docs/tutorial.py --run    # runs the notebook in an empty folder, and stores its outputs
    there and in the page, and its pictures

In the page, a block `sh` holds commands, a block `python` goes on where the one before it ended,
and a block `text` is what the block before it printed. A picture is a file that some block made; in
the notebook a cell shows it.
"""

import base64
import io
import json
import re
import shlex
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

from PIL import Image

PAGE = Path(__file__).with_name("tutorial.md")
NOTEBOOK = PAGE.with_suffix(".ipynb")
PICTURES = Path("pictures", "tutorial")
"""Folder of the pictures, from the page's."""
BLOCK = re.compile(r"^```(sh|python|text)\n(.*?)^```\n", re.M | re.S)
PICTURE = re.compile(rf"!\[[^\]]*\]\({PICTURES.as_posix()}/([\w.-]+)\)")
SET_UP = """# the commands of this notebook's own Python, whatever else is on the path
import os
import sys
from pathlib import Path

from IPython.display import Image

os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
"""
SHELL = "%%bash -e\n"
BEHIND = re.compile(r'<img src="data:image/\w+;base64,([^"]*)"')
"""The picture behind the page of a cell's value. It alone is stored: stored pages do not run."""
WIDE, COLOURS = 1000, 64
"""Most pixels of a stored picture's side, and its colours."""
LONGEST_S = 1800
"""How long a cell may run, seconds."""


def commands(page: str) -> list[list[str]]:
    """The words of every command line of the page, `scenegen` first."""
    lines = [
        line for kind, text in BLOCK.findall(page) if kind == "sh" for line in text.splitlines()
    ]
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def notebook(page: str, outputs: dict[str, Any] | None = None) -> dict[str, Any]:
    """The page as a notebook (nbformat 4.5): prose as it is, commands and Python in cells, pictures
    shown by cells; of each cell the `outputs` that its source had."""
    cells: list[dict[str, Any]] = []

    def add(kind: str, source: str) -> None:
        cell: dict[str, Any] = {"cell_type": kind, "id": f"cell-{len(cells)}", "metadata": {}}
        cell["source"] = source.splitlines(keepends=True)
        if kind == "code":
            cell |= {"execution_count": None, "outputs": (outputs or {}).get(source, [])}
        if source.strip():
            cells.append(cell)

    def prose(text: str) -> None:
        end = 0
        for found in PICTURE.finditer(text):
            add("markdown", text[end : found.start()].strip())
            add("code", f'Image("{found[1]}")')
            end = found.end()
        add("markdown", text[end:].strip())

    end = 0
    for found in BLOCK.finditer(page):
        prose(page[end : found.start()])
        if not end:
            add("code", SET_UP.strip())
        if found[1] != "text":
            add("code", (SHELL if found[1] == "sh" else "") + found[2].strip())
        end = found.end()
    prose(page[end:])
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return {"cells": cells, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}


def portable(data: dict[str, Any]) -> dict[str, Any]:
    """The data of an output with its picture as a PNG of few colours, which every viewer of
    notebooks shows; GitHub's shows no WebP, and no page."""
    behind = BEHIND.search("".join(data.get("text/html", "")))
    picture = behind[1] if behind else data.get("image/webp")
    if picture is None:
        return data
    image = Image.open(io.BytesIO(base64.b64decode(picture))).convert("RGB")
    image.thumbnail((WIDE, WIDE))
    file = io.BytesIO()
    image.quantize(COLOURS, dither=Image.Dither.NONE).save(file, "PNG", optimize=True)
    content = base64.b64encode(file.getvalue()).decode()
    return {"image/png": content, "text/plain": data["text/plain"]}


def stored() -> dict[str, Any]:
    """What the notebook's file holds of outputs, by the sources of cells."""
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"] if NOTEBOOK.is_file() else []
    return {"".join(cell["source"]): cell["outputs"] for cell in cells if "outputs" in cell}


def written(page: str, outputs: dict[str, Any] | None = None) -> str:
    """The notebook's file, with the outputs that it has unless others are given."""
    made = notebook(page, stored() if outputs is None else outputs)
    return json.dumps(made, indent=1, ensure_ascii=False) + "\n"


def run(page: str, folder: Path) -> tuple[str, dict[str, Any]]:
    """Run the page's notebook in the empty `folder`; the page with what its blocks printed, and
    the outputs of cells by their sources. Raises CellExecutionError where a cell fails."""
    import nbformat
    from nbclient import NotebookClient

    made = nbformat.reads(json.dumps(notebook(page)), as_version=4)
    at = {"metadata": {"path": str(folder)}}
    NotebookClient(made, timeout=LONGEST_S, kernel_name="python3", resources=at).execute()
    outputs: dict[str, Any] = {}
    for cell in made.cells:
        if cell.cell_type == "code":
            outputs[cell.source] = json.loads(json.dumps(cell.outputs))
    for cell in outputs.values():
        for one in reversed(range(1, len(cell))):  # what came in pieces becomes one text
            if cell[one - 1].get("name") == cell[one].get("name", ""):
                cell[one - 1]["text"] += cell.pop(one)["text"]
    for output in (one for cell in outputs.values() for one in cell):
        output.pop("execution_count", None)
        if output["output_type"] == "execute_result":
            output["output_type"] = "display_data"
        if "data" in output:
            output["data"] = portable(output["data"])
    printed = ""

    def done(found: re.Match[str]) -> str:
        nonlocal printed
        if found[1] == "text":
            return f"```text\n{printed.rstrip()}\n```\n"
        cell = outputs[(SHELL if found[1] == "sh" else "") + found[2].strip()]
        printed = "".join(one["text"] for one in cell if one.get("name") == "stdout")
        return found[0]

    return BLOCK.sub(done, page), outputs


def main(*options: str) -> int:
    """Exit code."""
    page = PAGE.read_text(encoding="utf-8")
    outputs = None
    if options == ("--check",):
        return int(not NOTEBOOK.is_file() or NOTEBOOK.read_text(encoding="utf-8") != written(page))
    if options == ("--run",):
        with tempfile.TemporaryDirectory() as folder:
            page, outputs = run(page, Path(folder))
            shutil.rmtree(PAGE.parent / PICTURES, ignore_errors=True)
            (PAGE.parent / PICTURES).mkdir(parents=True)
            for name in PICTURE.findall(page):
                shutil.copyfile(Path(folder, name), PAGE.parent / PICTURES / name)
        PAGE.write_text(page, encoding="utf-8")
    elif options:
        print(__doc__, file=sys.stderr)
        return 2
    NOTEBOOK.write_text(written(page, outputs), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
