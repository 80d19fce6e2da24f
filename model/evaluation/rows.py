"""The rows of the bench by their names: methods, networks, files of predictions."""

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

from lidarsim.registry import Registry
from scenegen.errors import ScenegenError, raised_as

if TYPE_CHECKING:  # whoever asks for the names alone loads no torch and no HDF5
    from scenegen.dataset.read import Dataset
    from scenegen.model.evaluation.methods import Method

METHODS = Registry(
    "method",
    {
        "returns": "scenegen.model.completion.unlearned:Returns",
        "conservative": "scenegen.model.completion.unlearned:Conservative",
        "extrude": "scenegen.model.completion.unlearned:Extrude",
        "truth": "scenegen.model.evaluation.methods:Truth",
        "seen": "scenegen.model.evaluation.visibility:Seen",
    },
)
"""Classes of completers and of rows, made without arguments; a user's own completer as
``module:Class``."""
USUAL = tuple(name for name in METHODS.known if name != "seen")
"""The rows without any named: `seen` compiles every world, and is measured when it is asked for."""


def find_method(name: str) -> "Method":
    """The row called `name`: a known one, or ``module:Class`` of a completer.

    Raises ScenegenError for a name that leads to none, and for a completer that does not keep the
    protocol.
    """
    from scenegen.model.evaluation.methods import Completed

    with raised_as(ScenegenError, "--method: "):
        found = METHODS.find(name)
    odd = f"--method {name}: cannot be made by calling it without arguments: "
    with raised_as(ScenegenError, odd, of=TypeError):
        made = found()
    if name in METHODS.known and hasattr(made, "completion"):  # a row itself, not a completer
        return made
    return Completed(made)


def rows_of(
    names: Sequence[str], weights: Sequence[str], predictions: Path | None
) -> "list[Method]":
    """Rows by their names, those of networks, and that of a file of predictions. Raises
    ScenegenError where two have one name, and where a row cannot be."""
    from scenegen.model.evaluation.methods import Predicted

    rows: list[Method] = [*map(find_method, names)]
    if weights:
        from scenegen.model.completion.completer import Completer  # the other rows need no torch

        rows += [Completer.from_pretrained(name, threads=1) for name in weights]
    if predictions is not None:
        rows.append(Predicted(predictions))
    named = [row.name for row in rows]
    if twice := [name for name in named if named.count(name) > 1]:
        raise ScenegenError(
            f"two rows are called {twice[0]!r}; give one of them, or rename its file or folder"
        )
    return rows


def check_rows(rows: "Sequence[Method]", datasets: "Sequence[Dataset]", split: str) -> None:
    """Raise DatasetError where a file of predictions is not of `split` of all `datasets`."""
    for row, dataset in product(rows, datasets):
        if (check := getattr(row, "check", None)) is not None:
            check(dataset, split)
