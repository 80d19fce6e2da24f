"""What formats may be told."""

from dataclasses import dataclass
from typing import Literal

from lidarsim.parameters import check, number


@dataclass(frozen=True, kw_only=True)
class Choices:
    """How samples are converted. Each format takes what concerns it."""

    unseen_invalid: bool = False
    """SemanticKITTI: mark voxels that no ray met as invalid. What is behind things is then left out
    of the score, and with it the task."""
    label: int = number(50, least=1, most=65535)
    """SemanticKITTI: the label of occupied voxels. 50 is its building, which its own table of
    classes keeps; its "other" labels count as empty there."""
    frame: Literal["body", "world"] = "body"
    """Frame of points: the body, or the world."""

    def __post_init__(self) -> None:
        check(self)
