"""Makes the link scenegen/model where a source archive has lost it, so that a wheel built from one
holds the network's code, too."""

from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class Link(BuildHookInterface):
    """Runs before a wheel is built."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Make the link."""
        link = Path(self.root, "scenegen", "model")
        if not link.exists():
            link.symlink_to(Path("..", "model"))
