"""Robots reach their goals, and the command flies, records, draws and flies again."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from lidarsim import GridSpec
from lidarsim.engines.voxels import FREE, OCCUPIED
from lidarsim.pose import rotate
from scenegen.base.errors import GenerationError
from scenegen.base.executors import undo_all
from scenegen.fly import Vehicle, missions, suite
from scenegen.fly.course import Course, read_recording
from scenegen.fly.loop import fly
from scenegen.fly.missions import Mission
from scenegen.logs.read import read_log
from scenegen.model.completion.protocol import Conservative, Returns
from scenegen.model.robots import NAMES, flights, mapping
from scenegen.model.robots.flights import ANEW, robot_maker
from scenegen.model.robots.mapping import MappingRobot
from tests.command_line import done, refused, rows, run
from tests.conftest import hall_in, remembered
from tests.refusals import refuses_command
from tests.scenegen.view.test_page import Seen

DEAR = ("pessimistic", "extrude")


@pytest.fixture(autouse=True)
def found_once(monkeypatch):
    """The shortest way of a mission is found once for all tests that fly it."""
    monkeypatch.setattr(missions, "search", partial(remembered, draw=missions.search))


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


def test_a_map_that_moves_along_is_that_of_one_grid():
    """What was seen from several places is what lies there, wherever the map is by now."""
    course = Course(world="pillar", flights=1)
    flying, robot = course.simulation(0), MappingRobot(Returns())
    robot.reset(flying.about())
    for _ in range(25):
        flying.step(np.float32([1.5, 1.0, 0.2, 0.0]))
        robot.act(flying.observe())
    truth = flying.world.truth(GridSpec(), robot.origin)["occupancy"]
    assert robot.observed.sum() > 100
    assert (truth | ~robot.observed).all()
    assert not (robot.observed & robot.free).any()
    middle = np.floor((flying.state[:3] - robot.origin) / 0.2)
    assert middle.tolist() == [40, 40, 20]


DEAD_END = """<mujoco>
<custom><numeric name="flight_bounds" data="-4 -9 0.5 18 9 2"/></custom>
<worldbody>
<geom type="plane" size="40 40 1"/>
<geom type="box" pos="12 0 2" size="0.1 4 2"/>
<geom type="box" pos="6 4 2" size="6 0.1 2"/>
<geom type="box" pos="6 -4 2" size="6 0.1 2"/>
<geom type="box" pos="7 0 2.3" size="11 9 0.1"/>
</worldbody></mujoco>"""


def test_a_dead_end_deeper_than_the_window_is_left(tmp_path, monkeypatch):
    """At its mouth, its end is 12 m behind: farther than the window reaches."""
    (tmp_path / "dead.xml").write_text(DEAD_END)
    course = Course(world=str(tmp_path / "dead.xml"), vehicle=Vehicle(speed_mps=4.0))
    bounds = ((-4.0, -9.0, 0.5), (18.0, 9.0, 2.0))
    mission = Mission(start=(1.0, 0.0, 1.2), goal=(16.0, 0.0, 1.2), shortest_m=25.0, bounds=bounds)
    monkeypatch.setattr(Course, "missions", [mission])
    flown = fly(course.simulation(0), MappingRobot(Returns()))
    assert flown.outcome == "success"
    assert flown.path[:, 0].min() < 0  # around the walls


def test_who_knows_the_truth_hits_nothing_at_full_speed(monkeypatch):
    """Behind a corner it would be carried into a wall, or out of bounds."""
    course = Course(world="maze", difficulty="easy", seed=901, vehicle=suite.VEHICLE)
    ends = {"start": (26.85, 9.35, 2.55), "goal": (11.45, 25.55, 4.75)}
    mission = Mission(**ends, shortest_m=20.0, bounds=course.drawn.flight_bounds)
    monkeypatch.setattr(Course, "missions", [mission])
    flying, robot = course.simulation(0), robot_maker("truth", None)(course)
    seen = flying.observe()
    assert fly(flying, robot).outcome == "success"
    monkeypatch.setattr(mapping, "refine", lambda way, *_: way[::9])  # through walls
    robot.path = None
    seen |= {"position": np.array([31.0, 27.0, 1.7]), "velocity": np.array([3.0, 0.0, 0.0])}
    assert robot.act(seen)[:3].max() < 1
    assert len(robot.path) > 9


class Idle:
    def reset(self, about):
        pass

    def act(self, observation):
        raise RuntimeError


class Fickle:
    """Every half a second, takes all that was not seen for free, or for occupied."""

    asked = 0

    def complete(self, observed, free, *, grid):
        self.asked += 1
        now = Conservative() if self.asked // 4 % 2 else Returns()
        return now.complete(observed, free, grid=grid)


def test_a_robot_keeps_its_way_when_beliefs_change():
    course = Course(world="pillar", flights=1, seed=2)
    kept, plain = (
        fly(course.simulation(0), robot)
        for robot in (MappingRobot(Fickle(), doubts=True), MappingRobot(Returns()))
    )
    assert kept.outcome == plain.outcome == "success"
    assert kept.ratio < 1.05
    assert kept.time_s < 1.3 * plain.time_s


@pytest.mark.parametrize("mark", [0.0, np.nan])
def test_ranges_that_say_nothing_mark_nothing(mark):
    flying = Course(world="pillar", flights=1, seed=2).simulation(0)
    observation, robot = flying.observe(), MappingRobot(Returns())
    robot.reset(flying.about())
    robot.act(observation | {"ranges": np.full_like(observation["ranges"], mark)})
    assert not (robot.observed | robot.free).any()


@pytest.mark.parametrize(("name", "remembers"), [("returns", False), ("optimistic", True)])
def test_a_network_completes_all_scans_or_the_last_alone(name, remembers):
    course = Course(world="pillar", flights=1, seed=2)
    flying, robot = course.simulation(0), robot_maker(name, "columns")(course)
    robot.reset(flying.about())
    robot.act(flying.observe())
    first = robot.observed.copy()
    assert first.any()
    robot.act(flying.observe() | {"ranges": np.full(flying.observe()["ranges"].shape, np.inf)})
    assert (robot.observed & first).any() == remembers


def test_the_command_flies_records_and_flies_again(capsys, tmp_path, monkeypatch):
    file, picture = tmp_path / "flights.json", tmp_path / "flights.png"
    film, log = tmp_path / "flight.html", tmp_path / "log"
    words = (
        "fly world pillar --robot reactive --flights 1 --worlds 1 --seed 4 --apart 4 --workers 1"
    )
    more = f"-o {file} --picture {picture} --film {film} --log {log} --json"
    told = json.loads(done(capsys, f"{words} {more}"))
    assert picture.read_bytes()[:4] == b"\x89PNG"
    ((course, (flown,)),) = read_recording(file).courses
    moments = Seen(film.read_text()).data()["samples"]
    assert len(moments) == (len(flown.commands) + 2) // 3 + 1
    assert moments[-1]["figures"]["reactive: path"].startswith(flown.outcome)
    scans = list(read_log(log).scans())
    assert len(scans) == len(flown.commands)
    for scan in scans[::10]:
        points = scan.pose.position + rotate(scan.pose.quaternion, scan.points)
        low, high = course.drawn.flight_bounds  # clearance knows no solids far beyond
        within = points[((points > low) & (points < high)).all(axis=1)]
        assert len(within) > 20
        assert max(course.drawn.clearance.at(*point) for point in within) < 1e-4
    again = tmp_path / "again.html"
    flown = json.loads(done(capsys, f"fly replay {file} --robot reactive --film {again} --json"))
    assert again.read_bytes() == film.read_bytes()
    assert [one["digest"] for one in flown["flights"]] == [one["digest"] for one in told["flights"]]
    assert flown[ANEW] == "1 of 1 flights"
    code, shown, line = run(capsys, f"fly replay {file} --robot optimistic --workers 1")
    assert code == 1
    assert "0 of 1 flights" in shown
    assert line.strip().splitlines()[-1] == (
        f"scenegen: {file}: optimistic flew 0 of 1 flights as they are recorded; the recording is "
        "of robot reactive"
    )
    code, shown, _ = run(capsys, f"fly replay {file} --robot no_such:Robot --workers 1")
    assert code == 1
    assert "no_such" in shown
    monkeypatch.setattr(flights, "fly_again", None)  # nothing is flown in vain
    assert str(log) in refused(capsys, f"{words} --log {log}")
    assert "no such network" in refused(capsys, f"fly replay {file} --weights nonet")


def test_an_entry_to_a_suite_goes_on_and_is_not_lost(capsys, tmp_path, monkeypatch):
    """What it holds is not flown again; a command for fewer, or other, courses leaves it alone."""
    monkeypatch.setattr(suite, "FLIGHTS", 1)
    courses = suite.courses_of("aerial-1")
    chosen = [one for one in courses if one.world == "pillar"][::10]
    asked = [chosen[:1], chosen, chosen[1:]]
    monkeypatch.setattr(suite, "chosen_courses", lambda *_, **__: asked.pop(0))
    file = tmp_path / "entry.json"
    words = f"fly suite --robot reactive --workers 1 -o {file}"
    done(capsys, words)
    (first,) = read_recording(file).courses
    assert not read_recording(file).complete
    file.write_bytes(file.read_bytes())  # as a copy from another machine: without our mark
    done(capsys, words)
    every = read_recording(file).courses
    assert [course.seed for course, _ in every] == [course.seed for course in chosen]
    assert every[0][1][0].step_s == first[1][0].step_s  # by the clock: no second flight has it
    kept = file.read_bytes()
    for again, told in (
        (words, "other courses"),
        (f"fly world pillar --robot reactive --flights 1 -o {file}", "entry"),
    ):
        assert told in refused(capsys, again)
        assert file.read_bytes() == kept
    told = f"{len(chosen)} of 300 courses, incomplete"
    assert told in done(capsys, f"fly replay {file} --workers 2")
    better = read_recording(file)
    best = [(course, [replace(one, outcome="success", score=98765.4)]) for course, (one,) in every]
    better = replace(better, robot="<b>better</b>", courses=best[::-1])
    (tmp_path / "better.json").write_bytes(better.encoded())
    (_, (lost,)), *_ = every
    lost = replace(lost, outcome="crashed", commands=lost.commands[:0], time_s=0.0)
    worse = replace(better, robot="worse", courses=[(best[0][0], [lost]), *best[1:]])
    (tmp_path / "worse.json").write_bytes(worse.encoded())
    page = tmp_path / "page.html"
    done(capsys, f"fly rank {tmp_path} -o {page}")
    shown = page.read_text()
    assert f"own: {told}" in shown
    assert shown.index("&lt;b&gt;better") < shown.index("reactive")
    assert "98765." not in shown  # scores follow from what was flown


def test_a_stopped_run_keeps_an_entry_and_tells_of_it(tmp_path, monkeypatch):
    """Until then it is written every few seconds; of flights without a suite nothing is kept."""
    course = Course(world="pillar", flights=1)
    flown = fly(course.simulation(0), Idle())
    courses = [replace(course, seed=n, document="ab") for n in range(3)]
    saved, said = [], []

    def stopped(work, tasks, on_start):
        yield work(tasks[0])
        saved.append(file.exists() and len(read_recording(file).courses))
        said.append(undo_all())
        monkeypatch.setattr(flights, "SAVED_S", 1e9)
        yield work(tasks[1])
        raise GenerationError("a worker was killed")

    for name in ("aerial-1", None):
        file = tmp_path / f"{name}.json"
        monkeypatch.setattr(flights, "SAVED_S", -1.0)
        given = (courses, lambda one: (one, [flown]), "idle", name, file)
        with pytest.raises(GenerationError):
            flights.fly_courses(*given, flights.crew_of(stopped))
    assert saved == [1, False]
    assert f"{tmp_path}/aerial-1.json holds 1 of 3 courses" in said[0]
    assert len(read_recording(tmp_path / "aerial-1.json").courses) == 2
    assert "no flight is kept" in said[1]
    assert not file.exists()


def test_hidden_and_real_tracks_are_flown_again_by_who_has_their_worlds(
    capsys, tmp_path, monkeypatch
):
    """An entry holds no seed and no folder; without its number, or its maps, it is refused."""
    states = np.full((60, 60, 15), FREE, np.uint8)
    states[30, :40] = OCCUPIED
    hall = Course(world=str(hall_in(tmp_path, states))).sha256[:16]
    monkeypatch.setattr(suite, "MAPS", {"hall.npz": hall})
    monkeypatch.setattr(suite, "MAP_COURSES", 1)
    monkeypatch.setattr(suite, "HIDDEN", 2)
    monkeypatch.setattr(suite, "FLIGHTS", 1)
    monkeypatch.setattr(suite, "HIDDEN_KINDS", ("pillar", "rooms"))
    for given, wrong in (("--hidden 77", "--hidden 78"), (f"--maps {tmp_path}", "")):
        file = tmp_path / f"{len(given)}.json"
        words = f"fly suite --robot reactive --workers 1 -o {file}"
        done(capsys, f"{words} {given}")
        entry = json.loads(file.read_text())
        assert entry["complete"]
        for n, one in enumerate(entry["courses"]):
            assert one["course"]["seed"] == n
            assert "/" not in one["course"]["world"]
        again = json.loads(done(capsys, f"fly replay {file} {given} --json"))
        flights = [one["flights"][0]["digest"] for one in entry["courses"]]
        assert [one["digest"] for one in again["flights"]] == flights
        assert run(capsys, f"fly replay {file} {wrong}")[0] == 1


OWN = """
class Robot:
    def reset(self, about):
        print("ready", about["goal"])
        self.goal = about["goal"]

    def act(self, observation):
        away = self.goal - observation["position"]
        return [*(1.5 * away / (away @ away) ** 0.5), 0.0]
"""


BAD = """
from my_robot import Robot

class Dies(Robot):
    def act(self, observation):
        raise RuntimeError("at once")

class Babbles(Robot):
    asked = 0

    def act(self, observation):
        self.asked += 1
        said = {1: "abc", 2: [[1, 2], [3]], 3: None}
        return said.get(self.asked, super().act(observation))
"""


def test_ones_own_robot_flies_and_its_bad_answers_are_counted(capsys, tmp_path, monkeypatch):
    (tmp_path / "my_robot.py").write_text(OWN)
    (tmp_path / "my_bad.py").write_text(BAD)
    monkeypatch.chdir(tmp_path)
    words = "fly world pillar --flights 1 --worlds 1 --workers 1 --json --robot my_bad:"
    for name, invalid, outcome, trouble in (
        ("Dies", 0, "crashed", "of my_bad.py: RuntimeError: at once"),
        ("Babbles", 3, "collision", ""),
    ):
        (one,) = json.loads(done(capsys, words + name))["flights"]
        assert (one["invalid"], one["outcome"]) == (invalid, outcome)
        assert trouble in one["trouble"]
        assert (one["time_s"] > 1) == (one["trouble"] == "")


BAD_USE = """
fly world
fly suite aerial-2
fly suite --hidden 7 --maps .
fly world pillar --robot optimist
fly world pillar --robot reactive --weights columns
fly world pillar --robot no_such:Robot --flights 1
"""


@pytest.mark.parametrize("words", [words for (words,) in rows(BAD_USE)])
def test_bad_use_ends_in_a_line(capsys, words):
    refuses_command(capsys, words)
