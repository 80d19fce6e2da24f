"""What a manifest says of noise: stages as text, and how far they move a return. It may come from a
stranger."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from lidarsim.noise import STAGES
from scenegen.dataset.rules import Rule, check, text
from scenegen.errors import BrokenError, printable, short

if TYPE_CHECKING:  # which imports MuJoCo, and reading takes none
    from lidarsim.noise.chain import Noise

MOST_STAGES_TEXT = 4000
"""Characters of the text of a dataset's stages."""
_ENTRY = {
    "stages": text(
        rf"[ -~]{{1,{MOST_STAGES_TEXT}}}", "stages of noise, as lidarsim.noise writes them"
    ),
    "bound_m": Rule(
        lambda value: value is None or (type(value) in (int, float) and 0 <= value < math.inf),
        "metres, or null",
    ),
}


def entry_of(noise: "Noise", max_range_m: float) -> dict[str, Any]:
    """What the manifest says of a chain with a sensor of that range; nothing of one without stages.
    Raises BrokenError for one that no manifest can hold."""
    if not noise.stages:
        return {}
    bound = noise.bound_m(max_range_m)
    entry = {"stages": noise.spelled(), "bound_m": bound if bound < math.inf else None}
    check_noise(entry)
    return {"noise": entry}


def check_noise(entry: Any) -> None:
    """Raise BrokenError unless a manifest's `noise` is a table as the format has it, or null."""
    if entry is not None:
        check(entry, _ENTRY, "noise", _ENTRY)


def is_ours(entry: Mapping[str, Any] | None) -> bool:
    """Whether all stages are scenegen's own, so that reading them imports nothing that a manifest
    names."""
    stages = entry["stages"].split(",") if entry else []
    return all(stage.partition(":")[0] in STAGES.known for stage in stages)


def noise_of(entry: Mapping[str, Any] | None, max_range_m: float) -> "Noise":
    """The chain of a manifest's entry whose stages `is_ours`. Raises BrokenError for one that
    cannot be, or whose bound is another."""
    from lidarsim.noise.chain import Noise

    try:
        found = Noise.parse(entry["stages"]) if entry else Noise()
    except ValueError as error:
        raise BrokenError(
            f"noise.stages = {short(entry['stages'] if entry else '')}: {printable(error)}"
        ) from None
    if entry and (bound := entry_of(found, max_range_m)["noise"]["bound_m"]) != entry["bound_m"]:
        raise BrokenError(
            f"noise.bound_m = {entry['bound_m']}: its stages have {bound} with this sensor"
        )
    return found
