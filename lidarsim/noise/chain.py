"""Chains of noise stages, and their text in command lines and recipes."""

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
"""The words for the sensor's own `noise`, and for no noise."""
MAX_STAGES = 20
"""The most stages of a chain."""
SUCH_AS = '"range:0.02,dropout:0.05"'


@dataclass(frozen=True)
class Noise:
    """Stages, applied in order; without stages a scan is unchanged.

    Raises ValueError if a stage that casts rays follows one whose work it would undo."""

    stages: tuple[Stage, ...] = ()
    """The faults, first to last."""

    def __post_init__(self) -> None:
        if len(self.stages) > MAX_STAGES:
            raise ValueError(f"noise: {len(self.stages)} stages, expected {MAX_STAGES} at most")
        # orders must not fall, and only order 2 may repeat
        for before, stage in zip(self.stages, self.stages[1:], strict=False):
            if stage.order < max(before.order, 2 * (before.order == stage.order)):
                raise ValueError(
                    f"noise: {_text(stage)} casts rays anew, so it comes before {_text(before)}, "
                    "and once; put motion first, then divergence, then the rest"
                )

    @classmethod
    def parse(cls, text: "str | Noise", sensor: Sensor | None = None) -> "Noise":
        """Read the text of a chain, such as ``divergence:3:returns=last,range:0.02``.

        Args:
            text: Stages by name, or a user's own as ``module:Object``, each with its values in the
                order of its fields, or by name. ``datasheet`` stands for the sensor's own noise,
                and ``none``, by itself, for no stage. A chain is returned unchanged.
            sensor: The sensor, for ``datasheet``.

        Returns:
            The chain.

        Raises:
            ValueError: In one line, if the text names no chain.
        """
        if isinstance(text, Noise):
            return text
        if text.strip() == NONE:
            return cls()
        stages: list[Stage] = []
        for part in text.split(","):
            if part.strip() == DATASHEET:
                datasheet = getattr(sensor, "noise", "")
                if not datasheet:
                    raise ValueError(
                        f"noise: this sensor comes with none for {DATASHEET!r}; expected stages, "
                        f"as {SUCH_AS}"
                    )
                stages += cls.parse(datasheet).stages
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
        """Apply the chain to a clean scan.

        Every stage has its own stream, so that a stage added at the end changes none before it.

        Args:
            scan: The clean scan.
            engine: Knows the scan's world.
            rng: Spawns the streams.
            albedo: (geoms,), see `View`.

        Returns:
            The sensor's returns.

        Raises:
            ValueError: If a stage cannot be called, or gives ranges that the sensor cannot have.
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
        """Return how far a return lies from a surface at most, metres; inf for no bound."""
        return sum(stage.bound_m(max_range_m) for stage in self.stages)

    def __str__(self) -> str:
        """The text that `parse` reads."""
        return ",".join(map(_text, self.stages))

    def spelled(self) -> str:
        """Write the chain with every value, so that later defaults do not change its meaning."""
        return ",".join(_text(stage, spelled=True) for stage in self.stages)


def _check_returns(returns: Any, scan: Scan, name: str) -> None:
    """Raise ValueError unless the stage called `name` gave returns of the scan's rays."""
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
    """Make the stage of a text such as ``range:0.02:share=0.01``."""
    words = text.split(":")
    known = words[0] in STAGES.builtin or len(words) == 1
    # a user's own is two words, ``module:Object``
    name, values = (words[0], words[1:]) if known else (":".join(words[:2]), words[2:])
    if not name:
        raise ValueError(f"noise: an empty stage; expected stages, as {SUCH_AS}")
    if not known and _number(words[1]) != words[1]:  # a misspelt name, with its value
        raise ValueError(f"noise: {STAGES.unknown(words[0])}")
    kind = STAGES.find(name)
    if not (isinstance(kind, type) and dataclasses.is_dataclass(kind)):
        raise ValueError(
            f"noise stage {name}: expected a dataclass, whose fields are its parameters"
        )
    fields = [item.name for item in dataclasses.fields(kind)]
    if "order" in fields:
        raise ValueError(
            f"noise stage {name}: `order` is a parameter; write it without annotation, as order = 2"
        )
    chosen: dict[str, Any] = {}
    for place, word in enumerate(values):
        field, named, value = word.rpartition("=")
        if not named and place < len(fields):
            field = fields[place]
        if field not in fields or field in chosen:
            raise ValueError(
                f"noise stage {name}: {word[:40]!a}: expected values of {', '.join(fields)}, each "
                "once, in this order or as name=value"
            )
        chosen[field] = _number(value)
    try:
        stage: Any = kind(**chosen)
        if not stage.bound_m(1.0) >= 0:  # a user's own may also take other arguments
            raise ValueError("its bound_m gives no metres")
    except (ValueError, TypeError) as error:
        raise ValueError(f"noise stage {name}: {error}") from None
    return stage


def _number(word: str) -> Any:
    """Convert a word to true, false or a number; return other words unchanged."""
    if word in ("true", "false"):
        return word == "true"
    for kind in (int, float):
        try:
            return kind(word)
        except ValueError:
            continue
    return word


def _text(stage: Stage, *, spelled: bool = False) -> str:
    """Write a stage as `_stage` reads it: with the values that are not defaults, or all."""
    names = {place: name for name, place in STAGES.builtin.items()}
    place = f"{type(stage).__module__}:{type(stage).__qualname__}"
    fields = dataclasses.fields(stage)  # type: ignore[arg-type]
    chosen = [
        f"{item.name}={_word(getattr(stage, item.name))}"
        for item in fields
        if spelled or getattr(stage, item.name) != item.default
    ]
    return ":".join([names.get(place, place), *chosen])


def _word(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
