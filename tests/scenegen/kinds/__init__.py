"""What the tests of kinds share: a world's solids as a recipe adds them, measured without the
recipe's own formulas."""

from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.spatial.transform import Rotation

from scenegen.worlds.drawing import Drawing

Geom, BOUNDS = mujoco.mjtGeom, np.array([[0.0, 0, 0], [1, 1, 1]])


@dataclass(frozen=True, eq=False)
class Solid:
    """One geom."""

    shape: mujoco.mjtGeom
    size: NDArray[np.float64]
    position: NDArray[np.float64]
    quaternion: NDArray[np.float64]

    @cached_property
    def span(self):
        """Its lowest and highest z, by its support function."""
        radius, half, _ = self.size
        turn = Rotation.from_quat(self.quaternion, scalar_first=True).as_matrix()
        *level, up = np.abs(turn[2])
        reach = {
            Geom.mjGEOM_SPHERE: radius,
            Geom.mjGEOM_BOX: self.size @ [*level, up],
            Geom.mjGEOM_CYLINDER: radius * np.hypot(*level) + half * up,
        }[self.shape]
        return self.position[2] - reach, self.position[2] + reach


def draw(kind, seed=0):
    """The solids of one world, in the order in which they are added."""
    spec = Drawing(BOUNDS)
    kind.add_to(spec, rng=np.random.default_rng(seed))
    return [Solid(g.type, np.array(g.size), np.array(g.pos), np.array(g.quat)) for g in spec.geoms]


def looks_uniform(values, low, high):
    """Whether values lie between the bounds and are spread evenly there (Kolmogorov and
    Smirnov)."""
    values = np.asarray(values, float)
    within = low - 1e-9 <= values.min() and values.max() <= high + 1e-9
    return bool(within and stats.kstest(values, stats.uniform(low, high - low).cdf).pvalue > 1e-3)


def looks_like_share(count, of, share):
    """Whether `count` of `of` is as a share drawn one by one would have it."""
    return bool(stats.binomtest(count, of, share).pvalue > 1e-3)
