"""Write the notebook of the tutorial from its page, or run the page.

    python docs/tutorial.py          # writes docs/tutorial.ipynb
    python docs/tutorial.py --check  # ends with 1 where the notebook is not what would be written
    python docs/tutorial.py --run    # runs all in an empty folder; writes the page's outputs and
    pictures, too

In the page, a block `sh` holds commands, a block `python` goes on where the one before it ended,
and a block `text` is what the block before it printed. A picture is a file that some block made.
"""

import contextlib
import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

PAGE = Path(__file__).with_name("tutorial.md")
NOTEBOOK = PAGE.with_suffix(".ipynb")
PICTURES = Path("pictures", "tutorial")
"""Folder of the pictures, from the page's."""
BLOCK = re.compile(r"^```(sh|python|text)\n(.*?)^```\n", re.M | re.S)
PICTURE = re.compile(rf"!\[[^\]]*\]\({PICTURES.as_posix()}/([\w.-]+)\)")


def commands(page: str) -> list[list[str]]:
    """The words of every command line of the page, `scenegen` first."""
    lines = [
        line for kind, text in BLOCK.findall(page) if kind == "sh" for line in text.splitlines()
    ]
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def notebook(page: str) -> dict[str, Any]:
    """The page as a notebook (nbformat 4.5): prose as it is, commands after an exclamation mark,
    and no outputs."""
    cells: list[dict[str, Any]] = []
    end = 0
    for found in [*BLOCK.finditer(page), None]:
        prose = page[end : found.start() if found else len(page)].strip()
        if prose:
            cells.append({"cell_type": "markdown", "source": prose})
        if found and found[1] != "text":
            code = found[2].strip()
            source = re.sub(r"^(?=scenegen )", "!", code, flags=re.M) if found[1] == "sh" else code
            cells.append(
                {"cell_type": "code", "source": source, "outputs": [], "execution_count": None}
            )
        end = found.end() if found else end
    for number, cell in enumerate(cells):
        cell |= {
            "id": f"cell-{number}",
            "metadata": {},
            "source": cell["source"].splitlines(keepends=True),
        }
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return {"cells": cells, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}


def written(page: str) -> str:
    """The notebook's file."""
    return json.dumps(notebook(page), indent=1, ensure_ascii=False) + "\n"


def run(page: str, folder: Path) -> str:
    """Run every block of the page in the empty `folder`, in order; the page with what they printed.

    Raises CalledProcessError, or what a Python block raises, where one fails.
    """
    names: dict[str, Any] = {"__name__": "__main__"}
    # the command of this very interpreter, whatever else is installed
    environment = {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
    }
    printed = ""

    def done(found: re.Match[str]) -> str:
        nonlocal printed
        kind, text = found.groups()
        if kind == "text":
            return f"```text\n{printed.rstrip()}\n```\n"
        print(text, end="", flush=True)
        if kind == "python":
            with contextlib.chdir(folder), contextlib.redirect_stdout(io.StringIO()) as said:
                exec(compile(text, "tutorial.md", "exec"), names)
            printed = said.getvalue()
        else:
            ran = subprocess.run(
                ["bash", "-ec", text],
                cwd=folder,
                env=environment,
                stdout=subprocess.PIPE,
                text=True,
                check=True,
            )
            printed = ran.stdout
        return found[0]

    return BLOCK.sub(done, page)


def main(*options: str) -> int:
    """Exit code."""
    page = PAGE.read_text(encoding="utf-8")
    if options == ("--check",):
        return int(not NOTEBOOK.is_file() or NOTEBOOK.read_text(encoding="utf-8") != written(page))
    if options == ("--run",):
        with tempfile.TemporaryDirectory() as folder:
            page = run(page, Path(folder))
            shutil.rmtree(PAGE.parent / PICTURES, ignore_errors=True)
            (PAGE.parent / PICTURES).mkdir(parents=True)
            for name in PICTURE.findall(page):
                shutil.copyfile(Path(folder, name), PAGE.parent / PICTURES / name)
        PAGE.write_text(page, encoding="utf-8")
    elif options:
        print(__doc__, file=sys.stderr)
        return 2
    NOTEBOOK.write_text(written(page), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
