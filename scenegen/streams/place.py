"""How far somebody has read, as a few bytes that fit nothing else."""

from collections.abc import Mapping
from typing import Any

from scenegen.errors import DatasetError, short


class Place:
    """A count of what was read, of what `of` says, in `unit`, up to `most`."""

    def __init__(self, of: Mapping[str, Any], unit: str, most: int):
        self._of, self._unit, self._most = dict(of), unit, most
        self.done = 0

    def state(self) -> dict[str, Any]:
        """What JSON takes."""
        return {**self._of, self._unit: self.done}

    def load(self, state: Any) -> None:
        """Go on from a `state`. Raises DatasetError for one of anything else."""
        if not isinstance(state, Mapping):
            raise DatasetError(
                f"state of a stream: {short(state)}: expected what state_dict() gave"
            )
        for name, ours in self._of.items():
            if state.get(name) != ours:
                raise DatasetError(
                    f"state of a stream: its {name} is {short(state.get(name))}, expected "
                    f"{short(ours)}: it is of "
                    "another one"
                )
        done = state.get(self._unit)
        if type(done) is not int or not 0 <= done <= self._most:
            raise DatasetError(
                f"state of a stream: its {self._unit} = {short(done)}: expected a whole number "
                f"from 0 to {self._most}"
            )
        self.done = done
