"""How bright a return is."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from lidarsim.noise.chance import normal
from lidarsim.noise.returns import Returns, View
from lidarsim.parameters import check, number


@dataclass(frozen=True, kw_only=True)
class Intensity:
    """Intensity as albedo × cosine of the angle of incidence (Lambert), freed of the range as
    sensors' own is, with normal noise of `sigma`, from 0 to 1."""

    order: ClassVar[int] = 2
    sigma: float = number(0.0, least=0, most=1)
    """Standard deviation of the noise."""

    def __post_init__(self) -> None:
        check(self)

    def apply(self, returns: Returns, view: View, *, rng: np.random.Generator) -> Returns:
        """See `Stage.apply`."""
        cosine, albedo = view.surfaces(returns)
        noise = self.sigma * normal(returns.ranges.shape, rng=rng)
        return returns.but(intensity=np.clip(albedo * cosine + noise, 0.0, 1.0))

    def bound_m(self, max_range_m: float) -> float:
        """See `Stage.bound_m`."""
        return 0.0
