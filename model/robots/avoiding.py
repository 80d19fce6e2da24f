"""Robots among movers: a map that forgets, movers found in scans and followed, and commands that
keep away from where movers will be."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from itertools import product

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from lidarsim.grid import Field, Floats, Ints, Mask
from lidarsim.movers import Movers
from lidarsim.pose import rotate
from lidarsim.scan import is_return
from scenegen.draw.movers import mover_voxels
from scenegen.fly.simulation import Observation
from scenegen.model.completion.protocol import ReturnsCompleter
from scenegen.model.robots.mapping import MappingRobot, TruthRobot
from scenegen.worlds.clearance import MoversClearance
from scenegen.worlds.world import World

HIT, MISS = 0.85, -0.4
"""What a return adds to the log odds of its voxel, and a ray to those that it crosses (Hornung et
al., "OctoMap", 2013)."""
STANDING = 0.2
"""What a mover's return adds: after a second in one voxel, it is mapped as what stands."""
LEAST_ODDS, MOST_ODDS = -2.0, 3.5
"""Bounds of the log odds, as there: a voxel that changes is believed after some scans."""
EMPTY_ODDS = -0.8
"""Log odds, two rays without a return, from which on a voxel counts as empty."""
DECAY_S = 10.0
"""A voxel that has had no return for so long is forgotten, seconds."""
LINK_M = 0.6
"""Points at most this far apart are of one mover, metres."""
FASTEST_MPS = 8.0
"""The greatest speed of a mover, metres a second."""
GATE_M = 1.0
"""A mover is at most this far from where it was expected, metres."""
FIT_S, KEPT_S = 0.6, 1.0
"""Over so many seconds a velocity is fitted; for so long a mover is expected on, unseen."""
MOST_POINTS = 40
"""Points of a mover from which distances are measured."""
AHEAD_S = np.arange(0.1, 1.55, 0.1)
"""When the vehicle must be clear of movers, seconds from now."""
ARRIVALS_S = np.arange(0.0, 2.5, 0.4)
"""When ways are looked at: a voxel is closed if a mover is there as the vehicle may arrive."""
REACTION_S = 0.15
"""So long a command changes nothing, seconds."""
MARGIN_M = 0.2
"""Room between vehicle and movers, metres."""
WAYS = np.array([way for way in product((-1.0, 0.0, 1.0), repeat=3) if any(way)])
WAYS /= np.linalg.norm(WAYS, axis=1, keepdims=True)


class AvoidingRobot(MappingRobot, ABC):
    """A robot that maps, and keeps away from movers as it expects them.

    Its way avoids the voxels where movers are expected as it may arrive there. Of its commands, one
    is flown that keeps `MARGIN_M` from movers for `AHEAD_S`: the path's own if it does, else the
    one most like it; if none does, the one that keeps farthest away."""

    @abstractmethod
    def movers_m(self, points: Floats, after_s: Floats) -> Floats:
        """Compute distances from movers, as they are expected.

        Args:
            points: (n, 3), world metres.
            after_s: (n,): when, seconds from now.

        Returns:
            (n,), metres.
        """

    @abstractmethod
    def mover_voxels(self, after_s: float) -> Ints:
        """Find the voxels of the window (n, 3) that movers are expected to touch.

        Args:
            after_s: When, seconds from now.
        """

    def act(self, observation: Observation) -> Floats:
        """See `Robot.act`."""
        self._position = observation["position"]
        self._time_s = float(observation["time_s"][0])
        wanted = super().act(observation)
        commands = np.concatenate([wanted[None, :3], np.zeros((1, 3)), 0.5 * WAYS, WAYS])
        commands[2:] *= float(self._about["speed_mps"])
        places = _places(commands, observation, float(self._about["acceleration_mps2"]))
        after_s = np.tile(AHEAD_S, len(commands))
        radius = float(self._about["radius_m"])
        gaps = self.movers_m(places[0], AHEAD_S) - radius
        if gaps.min() >= MARGIN_M:
            return wanted
        points = places.reshape(-1, 3)
        low, high = self._about["bounds"]
        edges = np.minimum(points - low, high - points).min(axis=1)
        standing = np.minimum(self._room(points) - radius, edges).reshape(len(commands), -1)
        gaps = (self.movers_m(points, after_s) - radius - MARGIN_M).reshape(standing.shape)
        # the path's own command keeps what room its path has
        standing[0] = np.maximum(standing[0], 0.0)
        least = np.minimum(gaps, standing).min(axis=1)
        unlike = np.linalg.norm(commands - commands[0], axis=1)
        best = np.argmin(np.where(least >= 0, unlike, np.inf)) if (least >= 0).any() else None
        return np.append(commands[least.argmax() if best is None else best], wanted[3])

    def believed(self) -> tuple[Mask, Field]:
        """See `MappingRobot.believed`."""
        occupied, risk = super().believed()
        cruise = 0.5 * float(self._about["speed_mps"])
        for after_s in ARRIVALS_S:
            voxels = self.mover_voxels(float(after_s))
            centres = self.origin + (voxels + 0.5) * self.grid.voxel_m
            away_s = np.linalg.norm(centres - self._position, axis=1) / cruise
            meets = tuple(voxels[abs(away_s - after_s) <= ARRIVALS_S[1]].T)
            occupied[meets], risk[meets] = True, 1.0
        return occupied, risk


def _places(commands: Floats, observation: Observation, pull: float) -> Floats:
    """Where each of some velocities (C, 3) leads, (C, T, 3), world metres, at `AHEAD_S`."""
    change = commands - observation["velocity"]
    takes_s = np.maximum(np.linalg.norm(change, axis=1), 1e-6)[:, None] / pull
    t = np.maximum(AHEAD_S - REACTION_S, 0.0)
    # the velocity changes evenly, then is the command's
    ramp = np.where(t < takes_s, t * t / (2.0 * takes_s), t - takes_s / 2.0)
    straight = observation["position"] + AHEAD_S[:, None] * observation["velocity"]
    return np.asarray(straight + ramp[..., None] * change[:, None])


@dataclass
class _Track:
    """A mover as the robot has seen it."""

    points: Floats
    """Its returns when it was last seen, (n, 3), world metres."""
    times_s: list[float] = field(default_factory=list)
    middles: list[Floats] = field(default_factory=list)
    """When it was seen in the last `FIT_S`, and the middle of its returns then."""

    def velocity(self) -> Floats:
        """Fit the velocity (3,), metres a second."""
        if len(self.times_s) < 3:
            return np.zeros(3)
        slope = np.polyfit(np.array(self.times_s), np.array(self.middles), 1)[0]
        return np.asarray(slope / max(float(np.linalg.norm(slope)) / FASTEST_MPS, 1.0))

    def see(self, points: Floats, time_s: float) -> None:
        """Add what a scan shows of it.

        Args:
            points: (n, 3): its returns, world metres.
            time_s: When, seconds.
        """
        self.points = points[:: -(-len(points) // MOST_POINTS)]
        self.times_s.append(time_s)
        self.middles.append(points.mean(axis=0))
        while self.times_s[0] < time_s - FIT_S:
            del self.times_s[0], self.middles[0]


class TrackingRobot(AvoidingRobot):
    """A robot whose map forgets, and that follows what moves.

    Rays lower the odds of the voxels that they cross, and old returns are forgotten. Returns from
    where a voxel and all around it were empty are of movers (Schmid et al., "Dynablox", 2023), and
    are not mapped.

    Args:
        predicts: Whether movers are expected to go on at their velocity; else, to stay.
        brakes: See `MappingRobot`.
    """

    def __init__(self, *, predicts: bool, brakes: float | None = None):
        super().__init__(ReturnsCompleter(), brakes=brakes)
        self._predicts = predicts

    def reset(self, about: Observation) -> None:
        """See `Robot.reset`."""
        super().reset(about)
        shape = self._known.shape[1:]
        self._odds = np.zeros(shape, np.float32)
        self._returned_s = np.zeros(shape, np.float32)
        self._empty = np.zeros(shape, bool)
        self._tracks = list[_Track]()

    def movers_m(self, points: Floats, after_s: Floats) -> Floats:
        """See `AvoidingRobot.movers_m`.

        Returns:
            (n,), metres, from returns; inf without movers.
        """
        nearest = np.full(len(points), np.inf)
        for track in self._tracks:
            lasting_s = after_s + (self._time_s - track.times_s[-1])
            there = points - lasting_s[:, None] * self._velocity(track)
            nearest = np.minimum(nearest, cdist(there, track.points).min(axis=1))
        return nearest

    def mover_voxels(self, after_s: float) -> Ints:
        """See `AvoidingRobot.mover_voxels`."""
        points = [
            track.points + (after_s + self._time_s - track.times_s[-1]) * self._velocity(track)
            for track in self._tracks
        ]
        index = self.grid.index(np.concatenate([np.empty((0, 3)), *points]), self.origin)
        return np.asarray(index[((index >= 0) & (index < self.grid.shape)).all(axis=1)])

    def _velocity(self, track: _Track) -> Floats:
        return track.velocity() if self._predicts else np.zeros(3)

    def _remember(self, window: tuple[slice, ...], observation: Observation) -> None:
        """See `MappingRobot._remember`."""
        odds, returned_s, empty = self._odds[window], self._returned_s[window], self._empty[window]
        moving = self.observed & empty
        odds += np.where(moving, STANDING, HIT) * self.observed + MISS * self.free
        np.clip(odds, LEAST_ODDS, MOST_ODDS, out=odds)
        returned_s[self.observed] = self._time_s
        odds[(odds > 0) & (self._time_s - returned_s > DECAY_S)] = 0.0
        self.observed, self.free = odds > 0, odds < 0
        empty |= _inner(odds <= EMPTY_ODDS)
        empty &= odds <= 0
        self._track(self._returns(moving, observation))

    def _returns(self, moving: Mask, observation: Observation) -> Floats:
        """The returns (n, 3) in `moving` voxels of the window, world metres."""
        ranges = observation["ranges"]
        hit = is_return(ranges, min_range_m=0.0)
        rays = rotate(observation["quaternion"], self._about["directions_body"][hit])
        points = self._pose.position + ranges[hit][:, None] * rays
        index = self.grid.index(points, self.origin)
        inside = ((index >= 0) & (index < moving.shape)).all(axis=1)
        return np.asarray(points[inside][moving[tuple(index[inside].T)]])

    def _track(self, points: Floats) -> None:
        """Follow movers by their returns (n, 3) now; forget those unseen for `KEPT_S`."""
        expected = [
            track.middles[-1] + (self._time_s - track.times_s[-1]) * track.velocity()
            for track in self._tracks
        ]
        for group in _linked(points, self.grid.voxel_m):
            apart = np.array(expected).reshape(-1, 3) - group.mean(axis=0)
            away = np.linalg.norm(apart, axis=1)
            nearest = int(away.argmin()) if len(away) else -1
            if nearest >= 0 and away[nearest] <= GATE_M:
                expected[nearest] = np.full(3, np.inf)
                track = self._tracks[nearest]
            else:
                track = _Track(group)
                self._tracks.append(track)
            track.see(group, self._time_s)
        self._tracks = [
            track for track in self._tracks if self._time_s - track.times_s[-1] <= KEPT_S
        ]


def _linked(points: Floats, cell_m: float) -> list[Floats]:
    """Divide points (n, 3) into groups (m, 3): those at most `LINK_M` apart are of one. Points are
    linked by the corners of the cells that hold them: all pairs of many would fill memory."""
    if not len(points):
        return []
    cells, of_cell = np.unique(np.floor(points / cell_m), axis=0, return_inverse=True)
    tree = KDTree(cells * cell_m)
    count, member = connected_components(tree.sparse_distance_matrix(tree, LINK_M))
    return [points[member[of_cell] == n] for n in range(count)]


def _inner(mask: Mask) -> Mask:
    """Voxels of a mask that have no voxel of another value around them."""
    for axis in range(3):
        inner = np.zeros_like(mask)
        ahead, middle, behind = (
            tuple(slice(*ends) if n == axis else slice(None) for n in range(3))
            for ends in ((2, None), (1, -1), (None, -2))
        )
        inner[middle] = mask[ahead] & mask[middle] & mask[behind]
        mask = inner
    return mask


class TruthAmongMovers(AvoidingRobot, TruthRobot):
    """Robot that knows the world and where its movers are, as a reference.

    Args:
        world: The world, with movers.
        predicts: Whether it also knows where they will be; else, it expects them to stay.
    """

    def __init__(self, world: World, *, predicts: bool):
        super().__init__(world)
        assert world.movers is not None
        self._movers: Movers = world.movers
        self._clearance, self._predicts = MoversClearance(world.movers), predicts

    def movers_m(self, points: Floats, after_s: Floats) -> Floats:
        """See `AvoidingRobot.movers_m`.

        Returns:
            (n,), metres, from solids; a metre at most.
        """
        return self._clearance.at(points, self._time_s + self._predicts * after_s)

    def mover_voxels(self, after_s: float) -> Ints:
        """See `AvoidingRobot.mover_voxels`."""
        time_s = self._time_s + self._predicts * after_s
        touched = mover_voxels(self._movers, self.grid, self.origin, time_s) >= 0
        # much faster than the indices of all axes at once
        return np.stack(np.unravel_index(np.flatnonzero(touched), touched.shape), axis=1)
