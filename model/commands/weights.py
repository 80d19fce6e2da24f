"""How trained networks are named on the command line, and the options of commands that show what
methods say of samples, beside the truth."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich_click as click
from click.shell_completion import CompletionItem

from scenegen.cli.options import group, together
from scenegen.cli.types import FILE
from scenegen.model.config import bundled, split_name, split_own, unknown_network

if TYPE_CHECKING:
    from scenegen.dataset.read import AnyDataset
    from scenegen.display.look import Guesses


class Weights(click.ParamType):
    """A bundled network's name, a file, a run's folder, or hf://user/name[@revision]; of one's own
    code, after its module:Class and @."""

    name = "weights"

    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        """The name as it is, if it can be one: a typo is told before torch is loaded.
        `Completer.from_pretrained` looks up what it leads to."""
        word = split_own(value)[1]
        path = Path(word)
        if not (word in bundled() or path.suffix or path.exists() or "/" in word):
            self.fail(unknown_network(word), param, ctx)
        return str(value)

    def shell_complete(self, ctx: Any, param: Any, incomplete: str) -> list[CompletionItem]:
        """Bundled networks that begin with what is typed, or else files."""
        items = [CompletionItem(name) for name in bundled() if name.startswith(incomplete)]
        return items or [CompletionItem(incomplete, type="file")]


class NamedWeights(Weights):
    """The network of a row, which NAME= before it names."""

    name = "[name=]weights"

    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        """The name as it is, see `Weights.convert`."""
        super().convert(split_name(str(value))[1], param, ctx)
        return str(value)


MAX_TRIAL = 10_000

shown_options = together(
    click.option(
        "--predictions",
        type=FILE,
        help="Predictions of the split, as `complete` writes, or one HDF5 file of them: shown "
        "beside the truth.",
    ),
    click.option(
        "--weights",
        type=NamedWeights(),
        multiple=True,
        help="A network that completes what is shown, as for `complete`, with a name of your own "
        "as NAME=WEIGHTS; repeatable.",
    ),
    click.option(
        "--trial",
        type=click.IntRange(0, MAX_TRIAL),
        default=0,
        help="Which of the bench's goals in the sample paths lead to.",
    ),
    click.option("--no-paths", is_flag=True, help="Plan no paths on what is predicted."),
    group("Predictions", "predictions weights trial no-paths"),
)
"""The options of `chosen`, by its parameters' names."""


def chosen(
    dataset: "AnyDataset",
    split: str,
    predictions: Path | None,
    weights: Sequence[str],
    trial: int,
    no_paths: bool,
) -> "tuple[Guesses | None, tuple[str, ...]]":
    """Who predicts samples of `dataset`, and what they are called. Raises ScenegenError for
    predictions that do not fit `split`, and for networks that are not there."""
    if not weights and predictions is None:
        return None, ()
    from scenegen.model.config import BenchConfig
    from scenegen.model.evaluation.methods import check_rows, rows_of
    from scenegen.model.evaluation.shown import guesses

    methods = rows_of((), weights, predictions)
    check_rows(methods, [dataset], split)
    names = tuple(method.name for method in methods)
    return partial(guesses, methods, BenchConfig(), None if no_paths else trial), names
