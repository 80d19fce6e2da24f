"""A course: all that flights depend on, but for who decides. It is small, and travels to other
processes; and a recording of flights through one, which are flown again from it."""

import hashlib
import json
import platform
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from lidarsim import Pose, Sensor
from lidarsim.noise.chain import Noise
from lidarsim.parameters import Checked, check, number
from lidarsim.scan import mounted
from lidarsim.sensors import RASTER
from scenegen import __version__
from scenegen.base.errors import DatasetError, GenerationError, printable
from scenegen.base.executors import processor
from scenegen.base.files import Json, read_bounded
from scenegen.base.limits import MOST_MANIFEST_BYTES, MOST_SEED
from scenegen.draw.source import named_world
from scenegen.fly import PERIOD_S, Rules, Vehicle
from scenegen.fly.loop import CLAIMED, HOVER, ROBOTS_END, Flown, scored, unlike
from scenegen.fly.missions import Mission, draw_missions, graded
from scenegen.fly.serve import numbers_of
from scenegen.fly.simulation import Observation, Simulation, bounded
from scenegen.logs import LogScan
from scenegen.truth.difficulty import Difficulty
from scenegen.worlds.place import Place
from scenegen.worlds.tables import named_lidar, named_noise
from scenegen.worlds.world import AnyWorld

FORMAT = 1
"""Of recordings."""


@dataclass(frozen=True, kw_only=True)
class Course(Checked):
    """Missions through one world. Raises ValueError for values of other types, and ScenegenError,
    where it is first used, for a world, a sensor or noise that cannot be."""

    world: str
    """A kind of worlds, or a file: MJCF, or a map of a real place."""
    seed: int = number(0, least=0, most=MOST_SEED)
    """What the world of a kind is drawn by, and the missions, and the noise."""
    difficulty: str | None = None
    """Of the kind's preset; None for its usual one."""
    lidar: str | Sensor = RASTER
    """The sensor's name, or its file; or a sensor, which no recording can name."""
    noise: str = ""
    """Stages of noise, as `--noise` has them."""
    moving: bool = False
    """Whether each ray is cast from where the sensor is when its turn comes."""
    vehicle: Vehicle = field(default_factory=Vehicle)
    rules: Rules = field(default_factory=Rules)
    flights: int = number(10, least=1)
    """Missions."""
    document: str = ""
    """The first digits of the world's SHA-256, where it has to be this world."""

    @cached_property
    def sensor(self) -> Sensor:
        """The sensor itself."""
        return named_lidar(self.lidar)

    @cached_property
    def chain(self) -> Noise:
        """The noise itself."""
        return named_noise(self.noise or None, self.sensor)

    @cached_property
    def drawn(self) -> AnyWorld:
        """The world itself."""
        found = named_world(self.world, self.seed, self.difficulty)
        check_document(hashlib.sha256(found.mjcf).hexdigest(), self)
        return found

    @cached_property
    def missions(self) -> Sequence[Mission]:
        """See `draw_missions`."""
        return draw_missions(self.drawn, self.vehicle, self.rules, self.flights, seed=self.seed)

    @cached_property
    def simulated(self) -> AnyWorld:
        """The world as it is flown through: what is unknown of a map is free there, as for rays,
        since no robot can see where knowledge ends."""
        drawn = self.drawn
        return replace(drawn, opened=True) if isinstance(drawn, Place) else drawn

    def graded(self) -> list[Difficulty]:
        """How hard each mission is."""
        return graded(self.drawn, self.vehicle.radius_m, self.missions)

    @property
    def sha256(self) -> str:
        """Of the world's document."""
        return hashlib.sha256(self.drawn.mjcf).hexdigest()

    def simulation(self, number: int) -> Simulation:
        """Mission `number`, about to begin."""
        return Simulation(
            self.simulated,
            self.missions[number],
            sensor=self.sensor,
            vehicle=self.vehicle,
            rules=self.rules,
            noise=self.chain,
            moving=self.moving,
            seed=self.seed,
        )


def check_document(sha256: str, course: Course) -> None:
    """Raise GenerationError where a world's hash is not that of a course."""
    if not sha256.startswith(course.document):
        raise GenerationError(
            f"{course.world}, seed {course.seed}: another world than the suite or the recording is "
            "of; take the file, and the version of scenegen, that they were made with"
        )


FlownCourse = tuple[Course, Sequence[Flown]]
"""A course, and all flights through it, in the order of its missions."""
Flights = Sequence[FlownCourse]


@dataclass(frozen=True, kw_only=True)
class Recording:
    """Flights, as a file keeps them: all but the ways, which follow from the commands."""

    robot: str
    """The robot's name."""
    network: str = ""
    """SHA-256 of the file of the network that the robot had complete; "" without one."""
    suite: str | None
    """The suite that it flew, where it did."""
    track: str = ""
    """Which of the suite's courses; see `scenegen.fly.suite.track_name`. "" where a recording of
    an earlier commit does not say."""
    complete: bool = False
    """Whether these are all courses."""
    courses: Flights

    def encoded(self) -> bytes:
        """As JSON, with what it was flown on. Commands are float32 in as many digits as tell them
        from all others. The maps of a suite are named without their folders."""
        found = []
        for course, flights in self.courses:
            rows = [
                one.row() | {"commands": [[float(str(x)) for x in row] for row in one.commands]}
                for one in flights
            ]
            about = asdict(course) | {"document": course.document or course.sha256}
            about["world"] = Path(course.world).name if self.suite else course.world
            found.append({"course": about, "flights": rows})
        text = {
            "format": FORMAT,
            "scenegen": __version__,
            "python": platform.python_version(),
            "numpy": np.__version__,
            "machine": platform.platform(),
            "cpu": processor(),
        }
        return (json.dumps(text | vars(self) | {"courses": found}) + "\n").encode()


def read_recording(path: Path) -> Recording:
    """Read what `Recording.encoded` wrote. Raises DatasetError for a file that is no recording."""
    try:
        text = json.loads(read_bounded(path, MOST_MANIFEST_BYTES))
        if text["format"] != FORMAT:
            raise DatasetError(f"{path}: has format {text['format']!a}, expected {FORMAT}")
        courses = []
        for one in text["courses"]:
            about = dict(one["course"])
            parts = {"vehicle": Vehicle(**about["vehicle"]), "rules": Rules(**about["rules"])}
            course, flights = Course(**about | parts), [*map(_flown, one["flights"])]
            if len(flights) != course.flights:
                raise ValueError(f"{len(flights)} of {course.flights} flights of a course")
            courses.append((course, flights))
        names = {name: printable(text.get(name, "")) for name in ("robot", "track", "network")}
        suite, whole = text["suite"], bool(text.get("complete"))
        return Recording(suite=suite and printable(suite), complete=whole, courses=courses, **names)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        said = f"{type(error).__name__}: {printable(error)}"[:200]
        raise DatasetError(f"{path}: no recording of flights ({said}); fly again") from None


def _flown(row: Json) -> Flown:
    """A flight of a recording. Raises ValueError for figures that cannot be."""
    numbers = numbers_of(row["commands"])
    if numbers is None:
        raise ValueError("commands that are not numbers")
    commands = numbers.reshape(-1, 4).astype(np.float32)
    flown = Flown(**row | {"commands": HOVER, "path": np.empty((0, 3))})
    check(flown)
    if not np.isfinite(commands).all():
        raise ValueError("commands that are not finite")
    if not -1e-6 < len(commands) * PERIOD_S - flown.time_s < PERIOD_S:
        raise ValueError(f"time_s = {flown.time_s} with {len(commands)} commands")
    return replace(flown, commands=commands)


def replay(course: Course, flights: Sequence[Flown]) -> list[Flown]:
    """Fly the recorded commands of a course again.

    A flight that the simulation does not end is taken for one that the robot ended, in the way that
    is recorded. What commands do not tell, such as the times of decisions, is as recorded, too.

    Raises:
        DatasetError: A flight is not as it was recorded.
        GenerationError: The world is another one than then, or has fewer missions.
    """
    found = []
    for n, flown in enumerate(flights):
        simulation = course.simulation(n)
        count = sum(1 for _ in flown_again(simulation, flown))
        if simulation.outcome is None:
            simulation.outcome = flown.outcome if flown.outcome in ROBOTS_END else "crashed"
        again = scored(simulation, list(flown.commands[:count]), [], Counter(), "")
        if faults := unlike(flown, again):
            raise DatasetError(
                f"flight {n} through {course.world}, seed {course.seed}, is not as it was "
                f"recorded: {faults[0]}"
            )
        found.append(replace(again, **{name: getattr(flown, name) for name in CLAIMED}))
    return found


def flown_again(simulation: Simulation, flown: Flown) -> Iterator[Observation]:
    """What was seen on a flight, while its commands are flown again."""
    for command in flown.commands:
        given, exceeds = bounded(command, simulation.vehicle)
        if simulation.outcome is not None or given is None or exceeds:
            return
        seen = simulation.observe()
        simulation.step(command)
        yield seen


def log_of(course: Course, number: int, flown: Flown) -> Iterator[LogScan]:
    """The log of a flight: what its sensor saw ten times a second, and when, from its own pose."""
    simulation = course.simulation(number)
    sensor = simulation.sensor
    arm = mounted(sensor, Pose.level((0.0, 0.0, 0.0), 0.0)).position
    times = (sensor.times_s * course.moving).astype(np.float32)
    for seen in flown_again(simulation, flown):
        hit = np.isfinite(seen["ranges"])
        pose = mounted(sensor, Pose(seen["position"], seen["quaternion"]))
        points = seen["points"][hit].astype(np.float64) - arm
        yield LogScan(float(seen["time_s"][0]), pose, points, {"t": times[hit]})
