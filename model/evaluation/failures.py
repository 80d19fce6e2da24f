"""Pictures of trials that failed: every method's path in the truth."""

import dataclasses
import io
from collections.abc import Sequence

from scenegen.dataset.read import Dataset
from scenegen.display.look import look_into
from scenegen.model.evaluation.methods import Method
from scenegen.model.evaluation.run import DatasetResult
from scenegen.model.evaluation.shown import guesses_of

MOST = 3
WIDE = 900
"""Pixels of a picture."""


def failing(result: DatasetResult, most: int = MOST) -> tuple[str, list[int]]:
    """The learned method that succeeds most often, and trials of different worlds in which its path
    meets an obstacle.

    "" and none where no method is learned.
    """
    learned = {name: found for name, found in result.methods.items() if found.learned}
    if not learned:
        return "", []
    name = max(learned, key=lambda one: sum(trial.success for trial in learned[one].trials))
    worlds: dict[int, int] = {}
    for n, trial in enumerate(learned[name].trials):
        if trial.hit is not None:
            worlds.setdefault(int(result.trial_worlds[n]), n)
    return name, list(worlds.values())[:most]


def draw_failures(
    result: DatasetResult, dataset: Dataset, methods: Sequence[Method]
) -> list[tuple[str, bytes]]:
    """What each picture shows, and the picture, WebP. Raises ImportError where matplotlib is not
    installed."""
    from PIL import Image

    from scenegen.display.figures import draw_paths
    from scenegen.display.panels import to_bytes

    shown = [
        method
        for method in methods
        if method.name in result.methods and result.methods[method.name].learned
    ]
    name, trials = failing(result)
    found = []
    for n in trials:
        index, turn = result.trial_places[n]
        look = look_into(
            dataset.split(result.config.split), index, guesses_of(shown, result.config, turn)
        )
        told = f"{name} fails: {look.name}, goal {turn}"
        figure = draw_paths([dataclasses.replace(look, name=f"{look.name}, goal {turn}")], title="")
        image = Image.open(io.BytesIO(to_bytes(figure, ".png"))).convert("RGB")
        image = image.resize(
            (WIDE, round(image.height * WIDE / image.width)), Image.Resampling.LANCZOS
        )
        memory = io.BytesIO()
        image.save(memory, "WEBP", quality=70)
        found.append((told, memory.getvalue()))
    return found
