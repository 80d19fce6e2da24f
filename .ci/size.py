"""The size of the code, and the ceilings under which it stays.

    python .ci/size.py

A token is one of Python's, without comments and docstrings; a string of several lines has as many
as it has words, since code in strings is code. A commit may raise a ceiling; its message says why.
"""

import ast
import io
import subprocess
import sys
import tokenize
from pathlib import Path

PRODUCT = ("lidarsim", "scenegen", "model")
TOKENS = {"product": 342_700, "benchmarks": 54_000, "tests": 215_200}
FILES = 236
LINES = 400
"""Lines of the longest file of product code, without docstrings, comments and blank lines: what
explains code costs nothing."""
WIDTH = 100
UNCOUNTED = {
    *(tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT),
    *(tokenize.ENDMARKER, tokenize.ENCODING),
}


def counted(text: str) -> list[tokenize.TokenInfo]:
    """The tokens of a module that count: no comments and docstrings."""
    docstrings: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        match node:
            case ast.Expr(value=ast.Constant(value=str())):
                docstrings.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    every = tokenize.generate_tokens(io.StringIO(text).readline)
    return [
        token for token in every if token.type not in UNCOUNTED and token.start[0] not in docstrings
    ]


def tokens(text: str) -> int:
    """How many tokens a module has."""
    total = 0
    for token in counted(text):
        is_long = token.type == tokenize.STRING and token.start[0] != token.end[0]
        total += len(token.string.split()) if is_long else 1
    return total


def lines_of_code(text: str) -> int:
    """How many lines of a module have a token that counts."""
    return len({n for token in counted(text) for n in range(token.start[0], token.end[0] + 1)})


def texts(folder: str) -> dict[str, str]:
    """The text of every Python file of a folder that git knows, links aside."""
    names = subprocess.check_output(["git", "ls-files", f"{folder}/*.py"], text=True).split()
    return {name: Path(name).read_text() for name in names if not Path(name).is_symlink()}


def main() -> None:
    """Print the sizes; exit with 1 where one is above its ceiling."""
    product = {name: text for folder in PRODUCT for name, text in texts(folder).items()}
    groups = {"product": product, "benchmarks": texts("benchmarks"), "tests": texts("tests")}
    broken = []
    for name, files in groups.items():
        total = sum(map(tokens, files.values()))
        print(f"{name}: {total} tokens (at most {TOKENS[name]}) in {len(files)} files")
        if total > TOKENS[name]:
            broken.append(f"{name} has {total} tokens, expected {TOKENS[name]} at most")
    if len(product) > FILES:
        broken.append(f"{len(product)} files of product code, expected {FILES} at most")
    for name, text in product.items():
        if (count := lines_of_code(text)) > LINES:
            broken.append(f"{name}: {count} lines of code, expected {LINES} at most")
    for name, text in {key: one for files in groups.values() for key, one in files.items()}.items():
        for number, line in enumerate(text.splitlines(), start=1):
            if len(line) > WIDTH:
                broken.append(f"{name}:{number}: {len(line)} characters, expected {WIDTH} at most")
    sys.exit("\n".join(broken) or 0)


if __name__ == "__main__":
    main()
