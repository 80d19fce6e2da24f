"""From a seed to a world, its truth, a flight through it, samples, and a dataset on disk.

    scenegen.generate("pillar", n=100, out="data/pillar")
    samples = scenegen.load("data/pillar", split="train")
    samples = scenegen.stream("pillar")    # the same samples, without a disk
    scenegen.show(samples[0])

The names in `__all__` are imported on first use.
"""

from __future__ import annotations

import os
import sys

TYPE_CHECKING = False  # as typing has it, which takes time to import: commands answer stops first
if TYPE_CHECKING:
    from typing import Any

    from scenegen.dataset.collection import load
    from scenegen.dataset.generation import generate
    from scenegen.dataset.read import Dataset
    from scenegen.draw.draw import scan_world
    from scenegen.draw.sample import Sample
    from scenegen.draw.source import read_world
    from scenegen.fly.environment import Flight
    from scenegen.model.api import bench, train
    from scenegen.model.completion.completer import Completer
    from scenegen.model.completion.protocol import Prediction
    from scenegen.model.network import Output
    from scenegen.model.training.data import collate
    from scenegen.streams.stream import stream
    from scenegen.verification.folder import verify
    from scenegen.view.live import view_live
    from scenegen.view.notebook import show
    from scenegen.worlds.flight import poses_in_flight
    from scenegen.worlds.kinds.kind import WorldKind
    from scenegen.worlds.recipe import Recipe, preset

__version__ = "0.3.0"

GENERATOR = 2
"""Raised whenever the same parameters and seed would give other bits, whatever the kind of worlds.
1 was bound to its processor: numpy and the mathematical library choose sines, arctangents and
products by what it offers."""

SPLITS = ("train", "val", "test")
"""The parts of a dataset, in order; no world is in two of them."""

__all__ = [
    "Completer",
    "Dataset",
    "Flight",
    "Output",
    "Prediction",
    "Recipe",
    "Sample",
    "WorldKind",
    "__version__",
    "bench",
    "collate",
    "generate",
    "load",
    "poses_in_flight",
    "preset",
    "read_world",
    "scan_world",
    "show",
    "stream",
    "train",
    "verify",
    "view_live",
]

_MODULES = {
    "scenegen.dataset.generation": "generate",
    "scenegen.dataset.collection": "load",
    "scenegen.dataset.read": "Dataset",
    "scenegen.view.live": "view_live",
    "scenegen.view.notebook": "show",
    "scenegen.fly.environment": "Flight",
    "scenegen.model.api": "bench train",
    "scenegen.model.completion.completer": "Completer",
    "scenegen.model.completion.protocol": "Prediction",
    "scenegen.model.network": "Output",
    "scenegen.model.training.data": "collate",
    "scenegen.worlds.recipe": "Recipe preset",
    "scenegen.worlds.kinds.kind": "WorldKind",
    "scenegen.draw.sample": "Sample",
    "scenegen.draw.source": "read_world",
    "scenegen.streams.stream": "stream",
    "scenegen.verification.folder": "verify",
    "scenegen.worlds.flight": "poses_in_flight",
    "scenegen.draw.draw": "scan_world",
}
"""Where each name of `__all__` stands. No module directly in this package may be called like one
of them: importing it would put it in the name's place."""


def __getattr__(name: str) -> Any:
    """What `__all__` lists, imported now. Of `scenegen.model`, this is all that the package
    knows."""
    from importlib import import_module

    from scenegen.base.errors import lacking

    for module, names in _MODULES.items():
        if name in names.split():
            try:
                value = getattr(import_module(module), name)
            except ModuleNotFoundError as error:
                if advice := lacking(error):
                    text = f"scenegen.{name} {advice}"
                    raise ModuleNotFoundError(text, name=error.name) from None
                raise
            globals()[name] = value
            return value
    raise AttributeError(f"module 'scenegen' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__


class _OnceImported:
    """Registers our environment when Gymnasium is imported. To import it here would take long."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> Any:
        """Find Gymnasium, whose import then also registers the environment. See
        `importlib.abc.MetaPathFinder`.

        Args:
            name: Name of the module to import.
            path: Unused.
            target: Unused.

        Returns:
            Gymnasium's spec; None for other modules, which are imported as usual.
        """
        if name != "gymnasium":
            return None
        from importlib.util import find_spec

        sys.meta_path.remove(self)
        spec = find_spec(name)
        if spec is not None and spec.loader is not None:
            run = spec.loader.exec_module

            def exec_module(module: Any) -> None:
                run(module)
                _register(module)

            spec.loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec


def _register(gymnasium: Any) -> None:
    gymnasium.register("scenegen/Fly-v0", entry_point="scenegen.fly.environment:Flight")


if "gymnasium" in sys.modules:
    _register(sys.modules["gymnasium"])
else:
    sys.meta_path.insert(0, _OnceImported())

# Where a checkout has lost its link scenegen/model, as in a zip or on Windows, the package is found
# beside this one.
if not os.path.isdir(os.path.join(__path__[0], "model")):  # noqa: PTH112, PTH118
    __path__.append(os.path.dirname(__path__[0]))  # noqa: PTH120
