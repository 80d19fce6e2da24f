"""Robots reach their goals, and the command flies, records, draws and flies again."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from lidarsim import GridSpec
from lidarsim.engines.voxels import FREE, OCCUPIED
from lidarsim.pose import rotate
from scenegen.base.errors import GenerationError
from scenegen.base.executors import undo_all
from scenegen.fly import Rules, Vehicle, missions, suite
from scenegen.fly.course import Course, Recording, read_recording
from scenegen.fly.loop import fly
from scenegen.fly.missions import Mission
from scenegen.logs.read import read_log
from scenegen.model.completion.protocol import Conservative, Prediction, ReturnsCompleter
from scenegen.model.robots import NAMES, flights, mapping
from scenegen.model.robots.film import ENDS, looks_of_flight, looks_of_recording
from scenegen.model.robots.flights import ANEW, robot_maker
from scenegen.model.robots.mapping import MappingRobot
from tests.command_line import done, run
from tests.conftest import hall_in, remembered
from tests.refusals import check_wording, refuses_command
from tests.scenegen import each_case
from tests.scenegen.view.test_page import Seen

DEAR = ("pessimistic", "extrude")
COURSE = Course(world="pillar", flights=1, seed=2)
AHEAD = np.float32([1.5, 1.0, 0.2, 0.0])


@pytest.fixture(autouse=True)
def found_once(monkeypatch):
    """The shortest way of a mission is found once for all tests that fly it."""
    monkeypatch.setattr(missions, "search", partial(remembered, draw=missions.search))


@pytest.fixture
def flying():
    """A flight that begins."""
    return COURSE.simulation(0)


def ready(robot, flying):
    """The robot, reset for a flight."""
    robot.reset(flying.about())
    return robot


def flown_mission(monkeypatch, course, robot, **ends):
    """A flight of the course on a mission of its own."""
    mission = Mission(shortest_m=20.0, bounds=course.drawn.flight_bounds, **ends)
    monkeypatch.setattr(Course, "missions", [mission])
    return fly(course.simulation(0), robot)


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] * (name in DEAR)) for name in NAMES],
)
def test_a_robot_reaches_its_goal(name):
    course = Course(world="pillar", difficulty="easy", flights=1, seed=1)
    flown = fly(course.simulation(0), robot_maker(name, None)(course))
    assert flown.outcome == "success", flown.trouble
    assert 0.9 < flown.ratio < (5 if name == "pessimistic" else 1.5)  # it explores
    assert flown.invalid == flown.speeding == 0


def test_maps_that_move_along_are_of_one_grid(flying):
    """What was seen from several places is what lies there, wherever the map is by now."""
    robot = ready(MappingRobot(ReturnsCompleter()), flying)
    for _ in range(25):
        flying.step(AHEAD)
        robot.act(flying.observe())
    truth = flying.world.truth(GridSpec(), robot.origin)["occupancy"]
    assert robot.observed.sum() > 100
    assert (truth | ~robot.observed).all()
    assert not (robot.observed & robot.free).any()
    assert GridSpec().index(flying.state[:3], robot.origin).tolist() == [40, 40, 20]


def test_dead_ends_deeper_than_the_window_are_left(monkeypatch):
    """At its mouth, its end is 12 m behind: farther than the window reaches."""
    world = str(Path(__file__).with_name("dead_end.xml"))
    course = Course(world=world, vehicle=Vehicle(speed_mps=4.0))
    ends = {"start": (1.0, 0.0, 1.2), "goal": (16.0, 0.0, 1.2)}
    flown = flown_mission(monkeypatch, course, MappingRobot(ReturnsCompleter()), **ends)
    assert flown.outcome == "success"
    assert flown.path[:, 0].min() < 0  # around the walls


def test_who_knows_the_truth_hits_nothing(monkeypatch):
    """Behind a corner it would be carried into a wall, or out of bounds."""
    vehicle = replace(suite.VEHICLE, speed_mps=6)
    course = Course(world="maze", difficulty="easy", seed=901, vehicle=vehicle)
    ends = {"start": (26.85, 9.35, 2.55), "goal": (11.45, 25.55, 4.75)}
    robot = robot_maker("truth", None)(course)
    flown = flown_mission(monkeypatch, course, robot, **ends)
    assert flown.outcome == "success"
    monkeypatch.setattr(mapping, "refine", lambda way, *_: way[::9])  # through walls
    robot.path = None
    places = {"position": np.array([31.0, 27.0, 1.7]), "velocity": np.array([3.0, 0.0, 0.0])}
    assert robot.act(course.simulation(0).observe() | places)[:3].max() < 1
    assert len(robot.path) > 9


class Knowing:
    """Predicts the world as it is."""

    def __init__(self, world):
        self.world, self.asked = world, 0

    def complete(self, observed, free, *, grid, seen):
        self.asked += 1
        truth = self.world.truth(grid, seen.origin)["occupancy"]
        return Prediction(occupancy_probability=truth.astype(np.float32))


def test_predictions_stay_where_they_are_between_completions(flying):
    always, seldom = networks = [Knowing(flying.world) for _ in range(2)]
    robots = [
        ready(MappingRobot(network, every=every), flying)
        for network, every in zip(networks, (1, 10), strict=True)
    ]
    for _ in range(20):
        observation = flying.observe()
        for robot in robots:
            robot.act(observation)
        assert robots[0].taken().tobytes() == robots[1].taken().tobytes()
        flying.step(AHEAD)
    assert always.asked == 20
    assert 2 <= seldom.asked <= 8


def test_a_path_that_fails_is_planned_on_a_new_prediction(flying, monkeypatch):
    network, planned = Knowing(flying.world), []
    robot = ready(MappingRobot(network, every=10, doubts=True), flying)
    observation = flying.observe()
    way = np.stack([flying.state[:3], flying.state[:3] + 0.5, observation["goal"]])
    monkeypatch.setattr(robot, "_plan", lambda *_: planned.append(network.asked) or way)
    robot.act(observation)
    robot.act(observation)
    assert (network.asked, planned) == (1, [1])
    robot._least_m = 99.0  # which no path keeps
    robot.act(observation)
    assert (network.asked, planned) == (2, [1, 2])


class Fickle:
    """Every half a second, takes all that was not seen for free, or for occupied."""

    asked = 0

    def complete(self, observed, free, *, grid):
        self.asked += 1
        now = Conservative() if self.asked // 4 % 2 else ReturnsCompleter()
        return now.complete(observed, free, grid=grid)


def test_robots_keep_their_way_when_beliefs_change():
    fickle, plain = (
        fly(COURSE.simulation(0), robot)
        for robot in (MappingRobot(Fickle(), doubts=True), MappingRobot(ReturnsCompleter()))
    )
    assert fickle.outcome == plain.outcome == "success"
    assert fickle.ratio < 1.05
    assert fickle.time_s < 1.3 * plain.time_s


def test_sampled_paths_repeat():
    robot = robot_maker("sampling", None)(COURSE)
    first, second = (fly(COURSE.simulation(0), robot).digest for _ in range(2))
    assert first == second


def test_ranges_of_no_return_mark_nothing(flying):
    observation, robot = flying.observe(), ready(MappingRobot(ReturnsCompleter()), flying)
    observation["ranges"][:], observation["ranges"][::2] = 0.0, np.nan
    robot.act(observation)
    assert not (robot.observed | robot.free).any()


@pytest.mark.parametrize(("name", "remembers"), [("returns", False), ("optimistic", True)])
def test_networks_complete_all_scans_or_one(flying, name, remembers):
    robot, observation = ready(robot_maker(name, "columns")(COURSE), flying), flying.observe()
    robot.act(observation)
    first = robot.observed.copy()
    assert first.any()
    observation["ranges"][:] = np.inf
    robot.act(observation)
    assert (robot.observed & first).any() == remembers


def digests_of(report):
    """What the flights of a command's JSON were, to the bit."""
    return [flight["digest"] for flight in report["flights"]]


def filmed(file):
    """The moments of a film, and what it shows of all of them."""
    shown = Seen(Path(file).read_text()).data()
    return shown["samples"], shown["film"]


def test_the_command_flies_and_flies_again(capsys, standing, monkeypatch):
    """Recorded, pictured, filmed and logged."""
    words = "fly world pillar --robot reactive --flights 1 --worlds 1 --seed 4 --apart 4"
    outputs = "--workers 1 -o f.json --picture f.png --film f.html --log log --json"
    first = json.loads(done(capsys, f"{words} {outputs}"))
    assert Path("f.png").read_bytes()[:4] == b"\x89PNG"
    ((course, (flown,)),) = read_recording(Path("f.json")).courses
    moments, film = filmed("f.html")
    assert len(moments) == (len(flown.commands) + 2) // 3 + 1
    assert moments[-1]["figures"]["reactive: path"].startswith(flown.outcome)
    speed, clearance = film["curves"].values()
    assert len(speed) == len(flown.commands) + 1
    assert min(clearance) == pytest.approx(flown.min_clearance_m, abs=1e-3)
    scans = list(read_log(Path("log")).scans())
    assert len(scans) == len(flown.commands)
    low, high = course.drawn.flight_bounds  # clearance knows no solids far beyond
    points = scans[9].pose.position + rotate(scans[9].pose.quaternion, scans[9].points)
    within = points[((points > low) & (points < high)).all(axis=1)]
    assert len(within) > 20
    assert max(course.drawn.clearance.at(*point) for point in within) < 1e-4
    replay = "fly replay f.json --workers 1"
    second = json.loads(done(capsys, f"{replay} --robot reactive --film again.html --json"))
    assert Path("again.html").read_bytes() == Path("f.html").read_bytes()
    assert digests_of(second) == digests_of(first)
    assert second[ANEW] == "1 of 1 flights"
    done(capsys, "view f.json -o view.html")
    assert filmed("view.html") == (moments, film)
    # --brakes is of the default robot
    for robot in ("--robot optimistic", "--brakes", "--robot no_such:Robot"):
        code, _, line = run(capsys, f"{replay} {robot}")
        assert code == 1
        check_wording(robot, line.strip().splitlines()[-1])
    monkeypatch.setattr(flights, "fly_again", None)  # nothing is flown in vain
    refuses_command(capsys, f"{words} --log log")
    refuses_command(capsys, "fly replay f.json --weights nonet")


class Straight:
    """Flies along x."""

    def reset(self, about):
        pass

    def act(self, seen):
        return [1.5, 0.0, 0.0, 0.0]


@pytest.fixture
def recorded(tmp_path):
    """Writes a recording of a flight along x; the flight and the file."""
    course, file = Course(world="pillar", seed=4, flights=1), tmp_path / "flights.json"

    def write(robot="mine:Robot"):
        flown = fly(course.simulation(0), Straight())
        recording = Recording(robot=robot, suite=None, courses=[(course, [flown])])
        file.write_bytes(recording.encoded())
        return flown, file

    return write


def test_a_recorded_robot_is_not_started(recorded):
    flown, file = recorded()
    look, *_ = looks_of_recording(file)
    assert "mine:Robot is not started" in look.missing[0]
    (end,) = look.film["ends"]
    assert end["text"].startswith(f"flight 0 {ENDS[flown.outcome]}")
    assert ("hit" in end) == (flown.outcome == "collision")


def test_a_recorded_map_is_shown(recorded):
    first, *_, last = looks_of_recording(recorded(robot="optimistic")[1])
    assert first.missing == ()
    assert last.guesses[0].occupied.any()


def test_a_changed_flight_is_not_shown(recorded, capsys):
    _, file = recorded()
    file.write_text(file.read_text().replace("[1.5, 0.0", "[-1.5, 0.0", 1))
    for more in ("", " --index 3"):
        refuses_command(capsys, f"view {file}{more} -o {file}.html")


def test_entries_to_a_suite_go_on(capsys, standing, monkeypatch):
    """What one holds is not flown again; a command for fewer, or other, courses leaves it alone."""
    monkeypatch.setattr(suite, "FLIGHTS", 1)
    frozen = suite.frozen_courses("drawn")
    chosen = [course for course in frozen if course.world == "pillar"][:30:10]
    parts = iter([chosen[:1], chosen, chosen, chosen[1:]])
    monkeypatch.setattr(suite, "chosen_courses", lambda *_, **__: next(parts))
    file, words = Path("entry.json"), "fly suite --robot reactive --workers 1 -o entry.json"
    done(capsys, f"{words} --latency 0.1")
    begun = read_recording(file)
    assert not begun.complete
    file.write_bytes(file.read_bytes())  # as a copy from another machine: without our mark
    done(capsys, f"{words} --latency 0.1")
    entry = read_recording(file)
    assert [course.seed for course, _ in entry.courses] == [course.seed for course in chosen]
    # by the clock: no second flight has it
    assert entry.courses[0][1][0].step_s == begun.courses[0][1][0].step_s
    held = file.read_bytes()
    for other in (f"{words} --latency 0.2", f"{words} --latency 0.1"):
        refuses_command(capsys, other)
    refuses_command(capsys, "fly world pillar --robot reactive --flights 1 -o entry.json")
    assert file.read_bytes() == held
    part = f"{len(chosen)} of 300 courses, incomplete"
    assert part in done(capsys, "fly replay entry.json --workers 2")
    courses = [
        (course, [replace(flown, outcome="success", score=98765.4)])
        for course, (flown,) in entry.courses
    ]
    better = replace(entry, robot="<b>better</b>", courses=courses[::-1])
    Path("better.json").write_bytes(better.encoded())
    Path("better.html").touch()  # its film
    done(capsys, "fly rank . -o page.html")
    shown = Path("page.html").read_text()
    for told in (f"drawn: {part}", "success, blocked line", "reactive, latency 0.1 s"):
        assert told in shown
    assert shown.index("&lt;b&gt;better") < shown.index("reactive")
    assert shown.count("src='better.html'") == shown.count("<iframe") == 1
    assert "98765." not in shown  # scores follow from what was flown


def test_stopped_runs_keep_an_entry(standing, monkeypatch):
    """Until then it is written every few seconds; of flights without a suite nothing is kept."""
    flown = fly(COURSE.simulation(0), Straight())
    courses = [replace(COURSE, seed=n, document="ab") for n in range(3)]
    file, saved, told = Path("e.json"), [], []

    def stopped(work, tasks, on_start):
        yield work(tasks[0])
        saved.append(file.exists() and len(read_recording(file).courses))
        told.append(undo_all())
        monkeypatch.setattr(flights, "SAVED_S", 1e9)
        yield work(tasks[1])
        raise GenerationError("a worker was killed")

    for name in (None, "aerial-2"):
        assert not file.exists()
        monkeypatch.setattr(flights, "SAVED_S", -1.0)
        work = courses, lambda course: (course, [flown]), "idle", name, file
        with pytest.raises(GenerationError):
            flights.fly_courses(*work, flights.crew_of(stopped))
    assert saved == [False, 1]
    assert "no flight is kept" in told[0]
    assert "e.json holds 1 of 3 courses" in told[1]
    assert len(read_recording(file).courses) == 2


@pytest.mark.parametrize(("given", "wrong"), [("--hidden 77", "--hidden 78"), ("--maps .", "")])
def test_secret_courses_are_flown_again_by_owners(capsys, standing, monkeypatch, given, wrong):
    """An entry holds no seed and no folder; without its number, or its maps, it is refused."""
    states = np.full((60, 40, 15), FREE, np.uint8)
    states[30, :26] = OCCUPIED
    hall = Course(world=str(hall_in(standing, states))).sha256[:16]
    settings = {"PLACE_COURSES": 1, "HIDDEN": 2, "FLIGHTS": 1, "KINDS": ("pillar", "rooms")}
    for name, value in {**settings, "frozen": lambda: {"places": {"hall.npz": hall}}}.items():
        monkeypatch.setattr(suite, name, value)
    done(capsys, f"fly suite --robot reactive --workers 1 -o e.json {given}")
    entry = json.loads(Path("e.json").read_text())
    assert entry["complete"]
    courses = [flown["course"] for flown in entry["courses"]]
    assert [course["seed"] for course in courses] == [*range(len(courses))]
    assert not [course for course in courses if "/" in course["world"]]
    again = json.loads(done(capsys, f"fly replay e.json {given} --json"))
    assert digests_of(again) == [flown["flights"][0]["digest"] for flown in entry["courses"]]
    assert run(capsys, f"fly replay e.json {wrong}")[0] == 1


OWN = """
class Robot:
    def reset(self, about):
        print("ready", about["goal"])
        self.asked = 0

    def act(self, observation):
        self.asked += 1
        return {1: "abc", 2: [[1, 2], [3]], 3: None}.get(self.asked, [0.0] * 4)

class Dies(Robot):
    def act(self, observation):
        raise RuntimeError("at once")
"""


@pytest.mark.parametrize(("name", "end"), [("Dies", (0, "crashed")), ("Robot", (3, "timeout"))])
def test_own_robots_fly_and_bad_answers_count(capsys, standing, name, end):
    (standing / "my_robot.py").write_text(OWN)
    words = f"fly world pillar --flights 1 --worlds 1 --workers 1 --json --robot my_robot:{name}"
    (flown,) = json.loads(done(capsys, words))["flights"]
    assert (flown["invalid"], flown["outcome"]) == end
    raised = "of my_robot.py: RuntimeError: at once" in flown["trouble"]
    assert raised == (name == "Dies")


@each_case("../model/bad_flights", "words")
def test_bad_use_ends_in_a_line(capsys, words):
    refuses_command(capsys, words)


def test_the_film_shows_where_a_flight_that_drifts_was():
    course = Course(world="pillar", flights=1, seed=4, rules=Rules(drift_m=5.0, drift_deg=20.0))
    flown = fly(course.simulation(0), robot_maker("reactive", None)(course))
    shown = looks_of_flight("reactive", course, 0, None, [flown])[-1]
    np.testing.assert_allclose(shown.guesses[0].route.points, flown.path, atol=1e-12)
