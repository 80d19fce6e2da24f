"""A course: all that flights depend on, except the robot. It is small, and is sent to other
processes. And recordings of flights through courses, with their replay."""

import hashlib
import json
import platform
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lidarsim import Pose, Sensor
from lidarsim.noise.chain import Noise
from lidarsim.parameters import Checked, check, number, short_repr
from lidarsim.scan import mounted
from lidarsim.sensors import RASTER
from scenegen import __version__
from scenegen.base.errors import DatasetError, GenerationError, printable
from scenegen.base.executors import processor
from scenegen.base.files import Json
from scenegen.base.limits import MAX_MANIFEST_BYTES, MAX_SEED
from scenegen.base.reading import read_bounded
from scenegen.draw.source import named_world
from scenegen.fly import PERIOD_S, Rules, Vehicle
from scenegen.fly.loop import CLAIMED, HOVER, ROBOTS_END, Flown, replay_differences, scored
from scenegen.fly.missions import Mission, draw_missions, graded
from scenegen.fly.serve import numbers_of
from scenegen.fly.simulation import Observation, Simulation, bounded
from scenegen.logs import LogScan
from scenegen.truth.difficulty import Difficulty
from scenegen.worlds.place import Place
from scenegen.worlds.tables import named_lidar, named_noise
from scenegen.worlds.world import AnyWorld

FORMAT = 2
"""Version of the format of recordings."""


@dataclass(frozen=True, kw_only=True)
class Course(Checked):
    """Missions through one world.

    Raises:
        ValueError: A value is of another type, or out of bounds.
        ScenegenError: At first use: there is no such world, sensor or noise.
    """

    world: str
    """A kind of worlds, or a file: MJCF, or a map of a real place."""
    seed: int = number(0, minimum=0, maximum=MAX_SEED)
    """Seed of the missions, of the noise, and of the world if `world` is a kind."""
    difficulty: str | None = None
    """Difficulty of the kind's preset; None for the usual one."""
    level: str = ""
    """How hard the course is in its suite; "" outside of one."""
    recipe: str = ""
    """Tables [world] and [flight] of a kind's recipe, as JSON: values that differ from the preset;
    "" for none."""
    lidar: str | Sensor = RASTER
    """The sensor's name, its file, or the sensor itself, which a recording cannot hold."""
    noise: str = ""
    """Stages of noise, as for `--noise`."""
    moving: bool = False
    """Whether each ray is cast from where the sensor is at the ray's time, and meets movers where
    they are then."""
    movers: Literal["", "light", "medium", "dense"] = ""
    """How many movers a kind's world has, as for `generate --movers`; "" for none."""
    scans: int = number(1, minimum=1, maximum=10)
    """How many scans an observation holds."""
    vehicle: Vehicle = field(default_factory=Vehicle)
    rules: Rules = field(default_factory=Rules)
    flights: int = number(10, minimum=1)
    """Number of missions."""
    document: str = ""
    """First digits of the SHA-256 that the world must have; "" for any world."""

    @cached_property
    def sensor(self) -> Sensor:
        """The sensor that `lidar` names."""
        return named_lidar(self.lidar)

    @cached_property
    def chain(self) -> Noise:
        """The noise that `noise` names."""
        return named_noise(self.noise or None, self.sensor)

    @property
    def tables(self) -> dict[str, Json]:
        """The tables that `recipe` holds.

        Raises:
            GenerationError: It is not JSON, or has other tables.
        """
        try:
            tables: Any = json.loads(self.recipe or "{}")
        # a stranger's JSON may be nested too deeply
        except (ValueError, RecursionError):
            tables = None
        # [lidar] could name a stranger's module, which would be imported
        if not isinstance(tables, dict) or not tables.keys() <= {"world", "flight"}:
            raise GenerationError(
                f"recipe = {short_repr(self.recipe)}: expected JSON with tables world and flight"
            )
        return tables

    @cached_property
    def drawn(self) -> AnyWorld:
        """The world that `world` names. Raises GenerationError if its hash is another."""
        movers, tables = self.movers or None, self.tables
        world = named_world(self.world, self.seed, self.difficulty, movers=movers, tables=tables)
        check_document(hashlib.sha256(world.mjcf).hexdigest(), self)
        return world

    @cached_property
    def missions(self) -> Sequence[Mission]:
        """The missions, see `draw_missions`."""
        return draw_missions(self.drawn, self.vehicle, self.rules, self.flights, seed=self.seed)

    @cached_property
    def simulated(self) -> AnyWorld:
        """The world for the flight itself. Unknown voxels of a map are free in it, as they are for
        rays, since no robot can see which voxels a map knows."""
        drawn = self.drawn
        return replace(drawn, opened=True) if isinstance(drawn, Place) else drawn

    def graded(self) -> list[Difficulty]:
        """Return the difficulty of each mission."""
        radius_m = self.vehicle.radius_m + self.rules.berth_m
        return graded(self.drawn, radius_m, self.missions)

    @property
    def sha256(self) -> str:
        """SHA-256 of the world's document."""
        return hashlib.sha256(self.drawn.mjcf).hexdigest()

    def simulation(self, number: int) -> Simulation:
        """Return a new simulation of mission `number`."""
        return Simulation(
            self.simulated,
            self.missions[number],
            sensor=self.sensor,
            vehicle=self.vehicle,
            rules=self.rules,
            noise=self.chain,
            moving=self.moving,
            scans=self.scans,
            seed=self.seed,
        )


def check_document(sha256: str, course: Course) -> None:
    """Check that a world is the one that a course means.

    Args:
        sha256: The world's hash.
        course: The course, whose `document` has the first digits.

    Raises:
        GenerationError: The hash does not begin with these digits.
    """
    if not sha256.startswith(course.document):
        raise GenerationError(
            f"{course.world}, seed {course.seed}: is another world than in the suite or the "
            "recording; use the same file, and the same version of scenegen"
        )


FlownCourse = tuple[Course, Sequence[Flown]]
"""A course, and the flights through it, in the order of its missions."""
Flights = Sequence[FlownCourse]


@dataclass(frozen=True, kw_only=True)
class Recording:
    """Flights as a file holds them: without paths, which follow from the commands."""

    robot: str
    """The robot's name."""
    network: str = ""
    """SHA-256 of the file of the robot's network; "" for a robot without one."""
    suite: str | None
    """The suite that was flown; None for other courses."""
    track: str = ""
    """Track of the suite, see `scenegen.fly.suite.track_name`; "" without a suite."""
    complete: bool = False
    """Whether all courses of the track were flown."""
    courses: Flights

    def encoded(self) -> bytes:
        """Return the recording as JSON, with the versions and the machine it was flown on.

        Commands are float32, in the fewest digits that restore all bits. Maps of a suite are named
        without their folder, so that recordings of two machines compare.
        """
        entries = []
        for course, flights in self.courses:
            rows = [
                flown.row() | {"commands": [[float(str(x)) for x in row] for row in flown.commands]}
                for flown in flights
            ]
            settings = asdict(course) | {"document": course.document or course.sha256}
            # other machines have the suite's maps in other folders
            settings["world"] = Path(course.world).name if self.suite else course.world
            entries.append({"course": settings, "flights": rows})
        text = {
            "format": FORMAT,
            "scenegen": __version__,
            "python": platform.python_version(),
            "numpy": np.__version__,
            "machine": platform.platform(),
            "cpu": processor(),
        }
        return (json.dumps(text | vars(self) | {"courses": entries}) + "\n").encode()


def read_recording(path: Path) -> Recording:
    """Read a file that holds `Recording.encoded`.

    Args:
        path: The file.

    Returns:
        The recording; its flights have no path yet.

    Raises:
        DatasetError: The file cannot be read, or is not a recording of this format.
    """
    try:
        text = json.loads(read_bounded(path, MAX_MANIFEST_BYTES))
        if text["format"] != FORMAT:
            raise DatasetError(
                f"{path}: has format {text['format']!a}, expected {FORMAT}; recordings of other "
                "versions cannot be read: fly again"
            )
        courses = []
        for entry in text["courses"]:
            settings = dict(entry["course"])
            parts = {"vehicle": Vehicle(**settings["vehicle"]), "rules": Rules(**settings["rules"])}
            course, flights = Course(**settings | parts), [*map(_flown, entry["flights"])]
            if len(flights) != course.flights:
                raise ValueError(f"{len(flights)} of {course.flights} flights of a course")
            courses.append((course, flights))
        if not courses:
            raise ValueError("without flights")
        # a stranger's words, which are printed and stand on pages
        names = {name: printable(text.get(name, "")) for name in ("robot", "track", "network")}
        suite, whole = text["suite"], bool(text.get("complete"))
        return Recording(suite=suite and printable(suite), complete=whole, courses=courses, **names)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        reason = f"{type(error).__name__}: {printable(error)}"[:200]
        raise DatasetError(f"{path}: is not a recording of flights ({reason}); fly again") from None


def _flown(row: Json) -> Flown:
    """Decode a flight of a recording. Raises ValueError if its figures are impossible."""
    numbers = numbers_of(row["commands"])
    if numbers is None:
        raise ValueError("commands that are not numbers")
    commands = numbers.reshape(-1, 4).astype(np.float32)
    # the commands and the path are not checked as parameters: they are arrays
    flown = Flown(**row | {"commands": HOVER, "path": np.empty((0, 3))})
    check(flown)
    if not np.isfinite(commands).all():
        raise ValueError("commands that are not finite")
    # a flight ends within its last period
    if not -1e-6 < len(commands) * PERIOD_S - flown.time_s < PERIOD_S:  # 1e-6: rounding
        raise ValueError(f"time_s = {flown.time_s} with {len(commands)} commands")
    return replace(flown, commands=commands)


def replay(course: Course, flights: Sequence[Flown]) -> list[Flown]:
    """Fly the recorded commands of a course again.

    If the simulation does not end a flight, the robot did, and the recorded outcome holds. Figures
    that do not follow from commands, such as decision times, are copied from the recording.

    Args:
        course: The course.
        flights: Its recorded flights, in the order of its missions.

    Returns:
        The flights, with their paths.

    Raises:
        DatasetError: A flight differs from its recording.
        GenerationError: The world is another one, or has fewer missions.
    """
    replayed = []
    for n, flown in enumerate(flights):
        simulation = course.simulation(n)
        count = sum(1 for _ in flown_again(simulation, flown))
        replayed.append(compared(course, n, simulation, flown, count))
    return replayed


def compared(
    course: Course, number: int, simulation: Simulation, flown: Flown, count: int
) -> Flown:
    """Compare a recorded flight with its replay.

    Args:
        course: The course.
        number: Number of the mission.
        simulation: The mission after `flown_again`.
        flown: The recorded flight.
        count: How many of its commands were flown.

    Returns:
        The flight with its path.

    Raises:
        DatasetError: The flights differ.
    """
    if simulation.outcome is None:
        # a recording cannot claim a success that the simulation did not see
        simulation.outcome = flown.outcome if flown.outcome in ROBOTS_END else "crashed"
    # times and counts of answers are not flown again: `CLAIMED` is copied below
    again = scored(simulation, list(flown.commands[:count]), [], Counter(), "")
    if faults := replay_differences(flown, again):
        raise DatasetError(
            f"flight {number} through {course.world}, seed {course.seed}, differs from its "
            f"recording: {faults[0]}"
        )
    return replace(again, **{name: getattr(flown, name) for name in CLAIMED})


def flown_again(
    simulation: Simulation, flown: Flown, *, blind: bool = False
) -> Iterator[Observation]:
    """Fly recorded commands again, as far as they are valid and the flight lasts.

    Args:
        simulation: A new simulation of the mission; it is moved.
        flown: The recorded flight.
        blind: Whether nothing is scanned, which is faster.

    Yields:
        The robot's observation before each command is flown; {} if `blind`.
    """
    for command in flown.commands:
        # a forged recording may hold commands that no vehicle can follow
        commands, exceeds = bounded(command, simulation.vehicle)
        if simulation.outcome is not None or commands is None or exceeds:
            return
        yield {} if blind else simulation.observe()
        simulation.step(command)


def flight_log(course: Course, number: int, flown: Flown) -> Iterator[LogScan]:
    """Make a log of a flight, with a scan for every period.

    Args:
        course: The course.
        number: Number of the mission.
        flown: The recorded flight.

    Yields:
        Scans, with the sensor's pose in the world and points in the sensor's frame, metres.
    """
    simulation = course.simulation(number)
    sensor = simulation.sensor
    arm = mounted(sensor, Pose.level((0.0, 0.0, 0.0), 0.0)).position
    # without `moving`, all rays are cast when the scan begins
    times = (sensor.times_s * course.moving).astype(np.float32)
    for seen in flown_again(simulation, flown):
        hit = np.isfinite(seen["ranges"])
        pose = mounted(sensor, simulation.pose)  # the true one, also where odometry drifts
        points = seen["points"][hit].astype(np.float64) - arm  # from the body to the sensor
        yield LogScan(float(seen["time_s"][0]), pose, points, {"t": times[hit]})
