"""Stages in a row, and how a command line and a recipe write them."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from lidarsim.engines import Caster
from lidarsim.grid import Floats
from lidarsim.noise import STAGES, Stage
from lidarsim.noise.returns import Returns, View
from lidarsim.registry import own_line
from lidarsim.scan import Scan, check_ranges
from lidarsim.sensors import Sensor

DATASHEET = "datasheet"
NONE = "none"
"""The word that stands for the sensor's own `noise`."""
MOST_STAGES = 20
"""The most stages of a chain."""
SUCH_AS = '"range:0.02,dropout:0.05"'


@dataclass(frozen=True)
class Noise:
    """Stages, applied in their order; none leaves a scan as it is.

    Raises ValueError for a stage that casts rays after one whose work it would undo.
    """

    stages: tuple[Stage, ...] = ()
    """What happens to the returns, first to last."""

    def __post_init__(self) -> None:
        if len(self.stages) > MOST_STAGES:
            raise ValueError(f"noise: {len(self.stages)} stages, expected {MOST_STAGES} at most")
        for before, stage in zip(self.stages, self.stages[1:], strict=False):
            if stage.order < max(before.order, 2 * (before.order == stage.order)):
                raise ValueError(
                    f"noise: {_text(stage)} casts rays anew, so it comes before {_text(before)}, "
                    "and once; put motion first, then divergence, then the rest"
                )

    @classmethod
    def parse(cls, text: "str | Noise", sensor: Sensor | None = None) -> "Noise":
        """The chain of a text such as ``divergence:3:returns=last,range:0.02``: stages by name, or
        a user's own as ``module:Object``, each with its values in the order of its fields, or by
        name. ``datasheet`` stands for the noise that the `sensor` comes with, and ``none``, by
        itself, for no stage. A chain is itself. Raises ValueError, in one line."""
        if isinstance(text, Noise):
            return text
        if text.strip() == NONE:
            return cls()
        stages: list[Stage] = []
        for part in text.split(","):
            if part.strip() == DATASHEET:
                own = getattr(sensor, "noise", "")
                if not own:
                    raise ValueError(
                        f"noise: this sensor comes with none for {DATASHEET!r}; expected stages, "
                        f"as {SUCH_AS}"
                    )
                stages += cls.parse(own).stages
            else:
                stages.append(_stage(part.strip()))
        return cls(tuple(stages))

    def observe(
        self,
        scan: Scan,
        engine: Caster,
        *,
        rng: np.random.Generator,
        albedo: Floats | None = None,
    ) -> Returns:
        """What the sensor of a clean `scan` really returns; `engine` knows the scan's world, and
        `albedo` is that of `View`. Every stage has a stream of its own, so that one added at the
        end changes none before it.

        Raises ValueError where a stage cannot be called, or gives what are no ranges of the sensor.
        """
        returns, view = Returns.of(scan), View(engine, scan.lidar, scan.pose, albedo)
        for stage, stream in zip(self.stages, rng.spawn(len(self.stages)), strict=True):
            name = f"noise stage {_text(stage)}"
            try:
                returns = stage.apply(returns, view, rng=stream)
            except TypeError as error:
                if own_line(error):  # within the user's method, which was called as it should be
                    raise
                raise ValueError(f"{name}: {error}; expected {STAGES.needs['apply']}") from None
            _check_returns(returns, scan, name)
        return returns

    def bound_m(self, max_range_m: float) -> float:
        """How far at most a return lies from a surface, metres; inf where nothing bounds it."""
        return sum(stage.bound_m(max_range_m) for stage in self.stages)

    def __str__(self) -> str:
        """The text that `parse` reads."""
        return ",".join(map(_text, self.stages))

    def spelled(self) -> str:
        """The same with every value, so that no later default changes what it says."""
        return ",".join(_text(stage, every=True) for stage in self.stages)


def _check_returns(returns: Any, scan: Scan, name: str) -> None:
    """Raise ValueError unless a stage, called `name`, gave returns of the scan's rays."""
    if not isinstance(returns, Returns):
        raise ValueError(f"{name} gave {type(returns).__name__}; expected Returns")
    for part in ("ranges", "intensity"):
        values = getattr(returns, part)
        shape = getattr(values, "shape", ())
        if values is not None and (not all(shape) or shape[1:] != scan.ranges.shape):
            raise ValueError(
                f"{name} gave {part} of shape {shape}; expected an array (echoes, *shape), with "
                f"shape = {scan.ranges.shape}"
            )
    check_ranges(returns.ranges, scan.lidar, name)


def _stage(text: str) -> Stage:
    """The stage that a text such as ``range:0.02:share=0.01`` names."""
    words = text.split(":")
    known = words[0] in STAGES.builtin or len(words) == 1
    name, values = (words[0], words[1:]) if known else (":".join(words[:2]), words[2:])
    if not name:
        raise ValueError(f"noise: an empty stage; expected stages, as {SUCH_AS}")
    if not known and _number(words[1]) != words[1]:  # a misspelt name, with its value
        raise ValueError(f"noise: {STAGES.unknown(words[0])}")
    found = STAGES.find(name)
    if not (isinstance(found, type) and dataclasses.is_dataclass(found)):
        raise ValueError(
            f"noise stage {name}: expected a dataclass, whose fields are its parameters"
        )
    fields = [item.name for item in dataclasses.fields(found)]
    if "order" in fields:
        raise ValueError(
            f"noise stage {name}: `order` is a parameter; write it without annotation, as order = 2"
        )
    given: dict[str, Any] = {}
    for place, word in enumerate(values):
        field, named, value = word.rpartition("=")
        if not named and place < len(fields):
            field = fields[place]
        if field not in fields or field in given:
            raise ValueError(
                f"noise stage {name}: {word[:40]!a}: expected values of {', '.join(fields)}, each "
                "once, in this order or as name=value"
            )
        given[field] = _number(value)
    try:
        made: Any = found(**given)
        if not made.bound_m(1.0) >= 0:  # a user's own may also take other arguments
            raise ValueError("its bound_m gives no metres")
    except (ValueError, TypeError) as error:
        raise ValueError(f"noise stage {name}: {error}") from None
    return made


def _number(word: str) -> Any:
    """A word of the text as a value: true, false, a number, or itself."""
    if word in ("true", "false"):
        return word == "true"
    for kind in (int, float):
        try:
            return kind(word)
        except ValueError:
            continue
    return word


def _text(stage: Stage, *, every: bool = False) -> str:
    names = {place: name for name, place in STAGES.builtin.items()}
    place = f"{type(stage).__module__}:{type(stage).__qualname__}"
    fields = dataclasses.fields(stage)  # type: ignore[arg-type]
    given = [
        f"{item.name}={_word(getattr(stage, item.name))}"
        for item in fields
        if every or getattr(stage, item.name) != item.default
    ]
    return ":".join([names.get(place, place), *given])


def _word(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
