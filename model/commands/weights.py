"""How a trained network is named on the command line."""

from typing import Any

import rich_click as click
from click.shell_completion import CompletionItem

from scenegen.model.config import bundled


class Weights(click.ParamType):
    """A bundled network's name, a file, a run's folder, or hf://user/name[@revision]."""

    name = "weights"

    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        """The name as it is; what it leads to is looked up by `Completer.from_pretrained`."""
        return str(value)

    def shell_complete(self, ctx: Any, param: Any, incomplete: str) -> list[CompletionItem]:
        """Bundled networks that begin with what is typed, or else files."""
        found = [CompletionItem(name) for name in bundled() if name.startswith(incomplete)]
        return found or [CompletionItem(incomplete, type="file")]
