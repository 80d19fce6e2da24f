"""A sensor on a body of a running simulation: it goes where the body goes, and sees what has
moved."""

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

HERE = Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
Told = TypeVar("Told")
Unseen = Literal["nothing", "body", "tree"]
"""What a sensor does not see of its carrier: nothing; the body's own geoms, as `bodyexclude` of
MuJoCo's rays; or those of the whole tree of bodies that moves with it, such as a robot with its
arms and wheels."""


class Attached:
    """A sensor on each of M bodies of a model. It serves one thread at a time.

    Every method reads where bodies and geoms are from the data that it is given, refits the
    hierarchy to what has moved, and casts the rays of all M sensors at once. After ``mj_step``,
    MuJoCo's own places are those from which the step began: ``mj_kinematics(model, data)`` brings
    them up to date. All methods raise ValueError for data that were never forwarded, or in which a
    geom's place is no number.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        body: str | Sequence[str],
        sensor: Sensor | None = None,
        *,
        offset: Pose | Sequence[Pose] = HERE,
        unseen: Unseen = "body",
        threads: int | None = None,
    ):
        """Mount `sensor` (a `Lidar` unless given) on a body of `model`, or one on each of several.

        `offset` is the sensor's pose in the body's frame, one for all or one for each; with several
        offsets and one body, all of them are on that. A `lever_arm_m` of the sensor's is added, in
        the offset's frame. Shapes, sizes and colours are read now, places at every scan. `threads`
        as for `AnalyticEngine`. Raises ValueError for a body that the model does not have, for what
        is no sensor, for counts that do not fit, and as `ModelSolids` does.
        """
        offsets = [offset] if isinstance(offset, Pose) else list(offset)
        if not all(isinstance(one, Pose) for one in offsets):
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
        self.sensor, self._model, self._threads = sensor or Lidar(), model, threads
        check_sensor(self.sensor)
        self._bodies = [_numbered(model, name) for name in names] * (count // len(names))
        self._offsets = offsets * (count // len(offsets))
        self._solids = ModelSolids(model)
        kin = model.body_rootid if unseen == "tree" else np.arange(model.nbody)
        self._parts = kin[model.geom_bodyid[self._solids.geom]]
        self._through = kin[self._bodies] if unseen != "nothing" else np.full(count, -1)
        self._engine: AnalyticEngine | None = None

    def poses(self, data: mujoco.MjData) -> tuple[Pose, ...]:
        """Where the M sensors are."""
        check_forwarded(self._model, data)
        return tuple(
            mounted(self.sensor, chained(Pose(data.xpos[body], data.xquat[body]), offset))
            for body, offset in zip(self._bodies, self._offsets, strict=True)
        )

    def cast(self, data: mujoco.MjData) -> tuple[Floats, Ints]:
        """Metres (M, *shape), inf where nothing is within the sensor's range, and the numbers of
        the geoms met, -1 where none."""
        return self._asked(AnalyticEngine.nearest, data)

    def hits(self, data: mujoco.MjData) -> Hits:
        """What `cast` gives, with points and normals, all (M, *shape)."""
        return self._asked(AnalyticEngine.hits, data)

    def scans(self, data: mujoco.MjData) -> tuple[Scan, ...]:
        """One scan a sensor."""
        ranges = self.cast(data)[0].astype(np.float32)
        return tuple(
            Scan(one, pose, self.sensor) for one, pose in zip(ranges, self.poses(data), strict=True)
        )

    def scan(self, data: mujoco.MjData) -> Scan:
        """The scan of a single sensor. Raises ValueError where there are several."""
        if len(self._bodies) > 1:
            raise ValueError(
                f"scan: {len(self._bodies)} sensors are attached; call scans, which gives one for "
                f"each"
            )
        return self.scans(data)[0]

    def observe(
        self, data: mujoco.MjData, noise: Noise | str, *, rng: np.random.Generator
    ) -> tuple[Returns, ...]:
        """What the M sensors return with `noise`, or the chain of that text, each by a stream of
        its own. Raises ValueError as stages and `Noise.parse` do."""
        chain = Noise.parse(noise, self.sensor)
        scans, engine, albedo = self.scans(data), self._engine, albedo_of(self._model)
        assert engine is not None
        past = [_past(engine, int(carrier)) for carrier in self._through]
        return tuple(
            chain.observe(scan, one, rng=stream, albedo=albedo)
            for scan, one, stream in zip(scans, past, rng.spawn(len(scans)), strict=True)
        )

    def _asked(self, ask: Callable[..., Told], data: mujoco.MjData) -> Told:
        """What a method of the engine says of the rays of all sensors, refitted to the data."""
        solids = self._solids.at(data)
        if self._engine is None:
            self._engine = AnalyticEngine(solids, threads=self._threads, parts=self._parts)
        else:
            self._engine.move(solids)
        poses, rays = self.poses(data), self.sensor.directions_body
        return ask(
            self._engine,
            [pose.position for pose in poses],
            [rotate(pose.quaternion, rays) for pose in poses],
            self.sensor.max_range_m,
            through=self._through,
        )


attach = Attached
"""The class as a verb: ``attach(model, "robot", Lidar()).scan(data)``."""


def _past(engine: AnalyticEngine, carrier: int) -> Any:
    """The engine as a sensor has it that does not see its carrier; see `View.engine`."""
    hits = partial(engine.hits, through=[carrier])
    return SimpleNamespace(hits=hits, cast=lambda *rays, **named: hits(*rays, **named).ranges)


def _numbered(model: mujoco.MjModel, name: str) -> int:
    """The number of the body called `name`."""
    found = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name))
    if found < 0:
        hint = suggestion(name, filter(None, (model.body(n).name for n in range(model.nbody))))
        raise ValueError(f"attach: the model has no body {name!r}; {hint[:100]}")
    return found
