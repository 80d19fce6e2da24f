"""A sensor on a body of a running simulation: it moves with the body, and sees where geoms are
now."""

from collections.abc import Callable, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any, Literal, TypeVar, get_args

import mujoco
import numpy as np

from lidarsim.engines.analytic import AnalyticEngine, Hits
from lidarsim.grid import Floats, Ints
from lidarsim.noise.chain import Noise
from lidarsim.noise.returns import Returns, albedo_of
from lidarsim.pose import Pose, chained, rotate
from lidarsim.registry import suggestion
from lidarsim.scan import Scan, mounted
from lidarsim.sensors import Sensor, check_sensor
from lidarsim.sensors.raster import Lidar
from lidarsim.solids import ModelSolids, check_forwarded

IDENTITY = Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
Answer = TypeVar("Answer")
Unseen = Literal["nothing", "body", "tree"]
"""Geoms of its carrier that a sensor does not see: none; the body's own, as with `bodyexclude` of
MuJoCo's rays; or those of the tree of bodies that moves with it, such as a robot with its arms and
wheels."""


class Attached:
    """A sensor on each of M bodies of a model. It serves one thread at a time.

    Attributes:
        sensor: The sensor.
        model: The model.

    Every method reads the places of bodies and geoms from the data that it gets, refits the
    hierarchy to those that have moved, and casts the rays of all M sensors at once. After
    ``mj_step``, MuJoCo's own places are those from which the step began: ``mj_kinematics(model,
    data)`` brings them up to date. All methods raise ValueError if data were never forwarded, or a
    geom's place is not finite."""

    def __init__(
        self,
        model: mujoco.MjModel,
        body: str | Sequence[str],
        sensor: Sensor | None = None,
        *,
        offset: Pose | Sequence[Pose] = IDENTITY,
        unseen: Unseen = "body",
        threads: int | None = None,
    ):
        """Mount a sensor on one body of a model, or on each of several.

        Shapes, sizes and colours are read now, places at every scan. A `lever_arm_m` of the sensor
        is added, in the offset's frame.

        Args:
            model: The compiled world.
            body: Names of the bodies; one name goes with several offsets.
            sensor: A `Lidar` with its defaults if None.
            offset: The sensor's pose in the body's frame: one for all bodies, or one each.
            unseen: Geoms of the carrier that rays pass through.
            threads: See `AnalyticEngine`.

        Raises:
            ValueError: If the model has no such body, `sensor` is not a sensor, or the counts of
                bodies and offsets differ; and as `ModelSolids` does.
        """
        offsets = [offset] if isinstance(offset, Pose) else list(offset)
        if not all(isinstance(item, Pose) for item in offsets):
            raise ValueError(f"attach: offset = {offset}: expected a Pose, or several")
        names = [body] if isinstance(body, str) else list(body)
        count = max(len(offsets), len(names))
        if {len(offsets), len(names)} - {1, count}:
            raise ValueError(
                f"attach: {len(names)} bodies and {len(offsets)} offsets, expected as many, or one "
                f"of either"
            )
        if unseen not in get_args(Unseen):
            raise ValueError(
                f"attach: unseen = {unseen!r}, expected one of {', '.join(get_args(Unseen))}"
            )
        self.sensor, self.model, self._threads = sensor or Lidar(), model, threads
        check_sensor(self.sensor)
        self._bodies = [_body_number(model, name) for name in names] * (count // len(names))
        self._offsets = offsets * (count // len(offsets))
        self._solids = ModelSolids(model)
        # solids of one number are one part: `hits` lets rays pass through a part at a time
        kin = model.body_rootid if unseen == "tree" else np.arange(model.nbody)
        self._parts = kin[model.geom_bodyid[self._solids.geom]]
        self._through = kin[self._bodies] if unseen != "nothing" else np.full(count, -1)
        # made with the first data, whose places its hierarchy needs
        self._engine: AnalyticEngine | None = None

    def poses(self, data: mujoco.MjData) -> tuple[Pose, ...]:
        """Compute the poses of the M sensors in the world."""
        check_forwarded(self.model, data)
        return tuple(
            mounted(self.sensor, chained(Pose(data.xpos[body], data.xquat[body]), offset))
            for body, offset in zip(self._bodies, self._offsets, strict=True)
        )

    def cast(self, data: mujoco.MjData) -> tuple[Floats, Ints]:
        """Cast the rays of all sensors.

        Returns:
            Metres (M, *shape), inf where nothing is within the sensor's range; and numbers of the
            geoms met, (M, *shape), -1 where none.
        """
        return self._call(AnalyticEngine.nearest, data)

    def hits(self, data: mujoco.MjData) -> Hits:
        """Cast the rays as `cast` does, and add points and normals, all (M, *shape)."""
        return self._call(AnalyticEngine.hits, data)

    def scans(self, data: mujoco.MjData) -> tuple[Scan, ...]:
        """Scan with every sensor, without noise."""
        ranges = self.cast(data)[0].astype(np.float32)
        return tuple(
            Scan(sensor_ranges, pose, self.sensor)
            for sensor_ranges, pose in zip(ranges, self.poses(data), strict=True)
        )

    def scan(self, data: mujoco.MjData) -> Scan:
        """Scan with the only sensor.

        Raises:
            ValueError: If there are several sensors.
        """
        if len(self._bodies) > 1:
            raise ValueError(
                f"scan: {len(self._bodies)} sensors are attached; call scans, which gives one for "
                f"each"
            )
        return self.scans(data)[0]

    def observe(
        self, data: mujoco.MjData, noise: Noise | str, *, rng: np.random.Generator
    ) -> tuple[Returns, ...]:
        """Scan with every sensor, with noise.

        Args:
            data: Where bodies and geoms are.
            noise: A chain, or its text.
            rng: Spawns a stream for each sensor.

        Returns:
            The returns of the M sensors.

        Raises:
            ValueError: As the stages and `Noise.parse` do.
        """
        chain = Noise.parse(noise, self.sensor)
        scans, engine, albedo = self.scans(data), self._engine, albedo_of(self.model)
        assert engine is not None
        # stages cast rays of their own, which must pass through the carrier, too
        views = [_through_carrier(engine, int(carrier)) for carrier in self._through]
        return tuple(
            chain.observe(scan, view, rng=stream, albedo=albedo)
            for scan, view, stream in zip(scans, views, rng.spawn(len(scans)), strict=True)
        )

    def _call(self, method: Callable[..., Answer], data: mujoco.MjData) -> Answer:
        """Call a method of the engine with the rays of all sensors, after a refit to `data`."""
        solids = self._solids.at(data)
        if self._engine is None:
            self._engine = AnalyticEngine(solids, threads=self._threads, parts=self._parts)
        else:
            # a refit is quicker than a new hierarchy, and as good while geoms keep their neighbours
            self._engine.move(solids)
        poses, rays = self.poses(data), self.sensor.directions_body
        return method(
            self._engine,
            [pose.position for pose in poses],
            [rotate(pose.quaternion, rays) for pose in poses],
            self.sensor.max_range_m,
            through=self._through,
        )


attach = Attached
"""The class as a verb: ``attach(model, "robot", Lidar()).scan(data)``."""


def _through_carrier(engine: AnalyticEngine, carrier: int) -> Any:
    """Wrap the engine so that its rays pass through the carrier."""
    hits = partial(engine.hits, through=[carrier])
    return SimpleNamespace(hits=hits, cast=lambda *rays, **named: hits(*rays, **named).ranges)


def _body_number(model: mujoco.MjModel, name: str) -> int:
    """Return the number of the body called `name`. Raises ValueError if there is none."""
    number = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name))
    if number < 0:
        hint = suggestion(name, filter(None, (model.body(n).name for n in range(model.nbody))))
        raise ValueError(f"attach: the model has no body {name!r}; {hint[:100]}")
    return number
