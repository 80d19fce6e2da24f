"""How a trained network is named on the command line."""

from pathlib import Path
from typing import Any

import rich_click as click
from click.shell_completion import CompletionItem

from lidarsim.registry import suggestion
from scenegen.model.config import bundled, split_own


class Weights(click.ParamType):
    """A bundled network's name, a file, a run's folder, or hf://user/name[@revision]; of one's own
    code, after its module:Class and @."""

    name = "weights"

    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        """The name as it is, if it can be one; `Completer.from_pretrained` looks up what it leads
        to."""
        word = split_own(value)[1]
        if (
            word not in bundled()
            and not Path(word).suffix
            and not Path(word).exists()
            and "/" not in word
        ):
            advice = "or give a .safetensors file, or a run's folder"
            self.fail(
                f"{word}: no such network; {suggestion(word, bundled())}; {advice}", param, ctx
            )
        return str(value)

    def shell_complete(self, ctx: Any, param: Any, incomplete: str) -> list[CompletionItem]:
        """Bundled networks that begin with what is typed, or else files."""
        found = [CompletionItem(name) for name in bundled() if name.startswith(incomplete)]
        return found or [CompletionItem(incomplete, type="file")]
