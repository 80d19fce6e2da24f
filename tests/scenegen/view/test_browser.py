"""The page in a real browser: needs Chromium and playwright, which is in none of our extras."""

import shutil
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from lidarsim import GridSpec
from scenegen.dataset.read import Dataset
from scenegen.view.live import view_live
from scenegen.view.look import Guess, Look, PlannedPath
from scenegen.view.page import page
from tests.command_line import beside
from tests.scenegen.test_moving_samples import moving as moving  # a fixture
from tests.scenegen.view.test_live import running as running  # a fixture
from tests.scenegen.view.test_live import served
from tests.scenegen.view.test_page import HOSTILE

pytestmark = pytest.mark.slow
NAMES = "chromium", "chromium-browser", "google-chrome"
CHROMIUM = next(filter(None, map(shutil.which, NAMES)), None)
SOFTWARE = "--no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader --ignore-gpu-blocklist"


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine")
    with playwright.sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE.split())
        yield opened
        opened.close()


@pytest.fixture
def reached(browser):
    """Opens an address; the page once its first sample shows. In the end, its console has said
    nothing against it, and nothing was requested of other places."""
    complaints = []

    def reach(address, first="body[data-sample='0']", lost=None, **how):
        allowed = address.partition("#")[0], "blob:"
        tab = browser.new_page(**{"viewport": {"width": 900, "height": 700}} | how)

        def note(kind, text):
            if kind == "error" and not (lost and lost in text):
                complaints.append(text)

        tab.on("console", lambda line: note(line.type, line.text))
        tab.on("pageerror", lambda error: note("error", str(error)))
        tab.on("dialog", lambda dialog: note("error", dialog.message) or dialog.dismiss())
        tab.on("request", lambda asked: asked.url.startswith(allowed) or note("error", asked.url))
        tab.goto(address)
        tab.wait_for_selector(first, state="attached", timeout=60_000)
        return tab

    yield reach
    assert complaints == []


def drag(tab, begin, end):
    """Turn what is shown, by a way along x in pixels."""
    tab.mouse.move(begin, 300)
    tab.mouse.down()
    tab.mouse.move(end, 300)
    tab.mouse.up()


def state(tab, name):
    """What a page says of itself."""
    return tab.evaluate(f"document.body.dataset.{name}")


def test_the_address_keeps_what_is_shown_and_a_click_tells_of_a_voxel(reached, made):
    with served(made) as server:
        place = f"{server.address}#sample=2&split=train&layers=occupancy~free"
        tab = reached(place, "body[data-sample='2']")
        assert state(tab, "layers").split()[-2:] == ["free", "occupancy"]
        box = tab.locator("canvas#scene").bounding_box()
        spots = [(0.55 + 0.05 * n, 0.4 + 0.05 * m) for n in range(6) for m in range(6)]
        # a busy machine may not have drawn yet
        for across, down in 3 * spots:
            tab.mouse.click(box["x"] + across * box["width"], box["y"] + down * box["height"])
            if said := tab.locator("#picked").inner_text():
                break
        assert "occupancy" in said or "free" in said
        assert " m." in said
        with tab.expect_download() as saved:
            tab.get_by_role("button", name="PNG").click()
        assert saved.value.suggested_filename == "sample-2.png"
        tab.keyboard.press("ArrowRight")
        tab.wait_for_url("**#sample=3&*")


def test_the_viewer_steps_through_datasets_and_splits_and_tells_what_is_damaged(
    reached, made, dataset
):
    (dataset / "train-00001.h5").unlink()  # samples 3 to 5

    def guesses(samples, index):
        sample = samples[index]
        ends = sample.origin + np.array([[1.0, 1.0, 1.0], [3.0, 3.0, 2.0]])
        route = PlannedPath(start=ends[0], goal=ends[1], points=ends, told="2.9 m")
        return [Guess(name=HOSTILE, occupied=sample.observed, tudf=sample.tudf, route=route)]

    with served(dataset, made, index=2, guesses=guesses, methods=(HOSTILE,)) as server:
        tab = reached(server.address, "body[data-sample='2']", lost="404")
        assert {"paths", "occupancy", "observed"} <= set(state(tab, "layers").split())
        tab.get_by_role("button", name="wrong").click()
        assert "invented" in state(tab, "layers")
        assert "2.9 m" in tab.locator("#figures").inner_text()
        tab.get_by_label("world").check()
        tab.wait_for_selector("body[data-layers~='world']", state="attached")
        tab.get_by_label("missed").check()
        assert "missed" in state(tab, "layers")
        tab.get_by_label("distances", exact=True).check()
        assert f"{HOSTILE}: distances" in state(tab, "layers")
        tab.locator("canvas#scene").click()
        tab.keyboard.press("ArrowRight")
        tab.wait_for_selector("body[data-sample='3']", state="attached")
        assert "train-00001.h5" in tab.locator("#notes").inner_text()
        tab.keyboard.press("End")
        tab.wait_for_selector("body[data-sample='10']", state="attached")
        assert tab.locator("#notes").inner_text() == ""
        tab.locator("#split").select_option("test")
        tab.wait_for_selector("body[data-sample='0']", state="attached")
        tab.locator("#number").fill("1")
        tab.locator("#number").press("Enter")
        tab.wait_for_selector("body[data-sample='1']", state="attached")
        tab.locator("#dataset").select_option(index=1)
        tab.wait_for_selector("body[data-sample='0']", state="attached")
        assert int(state(tab, "milliseconds")) < 2000


PIXELS = beside(__file__, "pixels.js")


def test_views_side_by_side_have_one_camera(reached, made):
    """Views of the same layer are the same picture, however it is turned; the address keeps
    them."""
    with served(made) as server:
        place = f"{server.address}#layers=rays&views=observed~observed~occupancy"
        tab = reached(place)
        seen = []
        for across in (500, 560):
            drag(tab, 500, across)
            tab.wait_for_timeout(500)
            one, same, other = tab.evaluate(PIXELS)
            assert one == same != other
            seen.append(one)
        assert seen[0] != seen[1]
        tab.get_by_label("view 2").select_option("free")
        tab.wait_for_url("**views=observed%7Efree%7Eoccupancy*")
        assert "free" in state(tab, "layers")
        tab.get_by_role("button", name="truth").click()
        assert state(tab, "views") == "1"


def drawn(tab):
    """The layers that a page draws, without its frame."""
    return [name for name in state(tab, "layers").split() if not name.startswith("#")]


@pytest.fixture
def film(tmp_path):
    """The file of a page: three moments in a room of 4 m with floor and ceiling, and a plan."""
    grid = GridSpec(shape=(20, 20, 10), voxel_m=0.2)
    room = np.zeros(grid.shape, bool)
    room[:, :, [0, -1]] = room[0] = room[5, 5] = True
    moments = []
    for n in range(3):
        seen = np.zeros(grid.shape, bool)
        seen[: n + 1, :, 0] = True
        way = np.array([[1.0, 1.0, 1.0], [1.0 + n, 1.5, 1.0]])
        route = PlannedPath(start=way[0], goal=way[1], points=way, told="under way")
        look = Look(
            name=f"{n}.0 s",
            grid=grid,
            origin=np.zeros(3),
            position=way[1],
            quaternion=np.array([1.0, 0.0, 0.0, 0.0]),
            masks={"occupancy": room, "observed": seen},
            guesses=(Guess(name="robot", occupied=seen, tudf=None, route=route),),
        )
        moments.append(look)
    end = {
        "text": "flight 0 hits an obstacle after 2.00 s at 3.00, 1.50, 1.00 m",
        "hit": way[1].tolist(),
    }
    curves = {"speed, m/s": [n / 10 for n in range(21)], "least clearance, m": [1.0] * 20 + [0.3]}
    flight = {"flight": 0, "ends": [end], "period_s": 0.1, "time_s": 2.0, "curves": curves}
    moments[0] = replace(moments[0], film=flight)
    file = tmp_path / "film.html"
    file.write_text(page(moments, title="a flight", film=True))
    return file.as_uri()


def test_a_flight_has_curves_and_hits(reached, film):
    tab = reached(film)
    assert "after 2.00 s at 3.00, 1.50, 1.00 m" in tab.locator("#outcome").inner_text()
    speed = tab.locator(".curve").first
    assert speed.locator(".hit").count() == 1
    box = speed.bounding_box()
    tab.mouse.move(box["x"] + box["width"] / 2, box["y"] + 5)
    assert "1.00 m/s at 1.0 s" in tab.locator("#curves").inner_text()
    speed.click()  # in its middle
    tab.wait_for_selector("body[data-sample='1']", state="attached")


def test_the_camera_follows_until_it_is_turned(reached, film):
    tab = reached(film)
    tab.locator("#camera").select_option("behind")
    tab.wait_for_timeout(400)
    seen = tab.evaluate(PIXELS)
    tab.locator("#next").click()
    tab.wait_for_timeout(400)
    assert tab.evaluate(PIXELS) != seen
    drag(tab, 600, 640)
    assert tab.locator("#camera").input_value() == "free"


def test_movers_play(reached, moving):
    sample = Dataset(moving).split("train")[0]
    movers, now = sample.motion.movers, sample.scan_times[0]

    def mover(after_s):
        (place, *_), ((x, y), *_), *_ = movers.poses(now + after_s)
        return [*(place - sample.origin), np.arctan2(y, x)]

    with served(moving) as server:
        tab = reached(f"{server.address}#split=train")
        assert {"movers", "ghosts", "observed"} <= set(drawn(tab))
        tab.get_by_role("button", name="truth").click()
        assert drawn(tab) == ["movers", "occupancy"]
        assert "movers of the world: person" in tab.locator("#legend").inner_text()
        seen = []
        for after_s in (0.0, float(sample.scan_times.min() - now), 1.25):
            tab.locator("#moment").fill(str(after_s))
            assert_allclose(np.array(state(tab, "mover").split(), float), mover(after_s), atol=1e-4)
            seen.append(tab.evaluate(PIXELS))
        tab.wait_for_url("**time=1.250*")
        assert seen[0] != seen[2]
        tab.keyboard.press("Space")
        tab.wait_for_selector("body[data-moment^='-']", state="attached")  # the begin, again
        tab.keyboard.press("Space")
        tab.locator("#next").click()
        tab.wait_for_selector("body[data-sample='1']", state="attached")
        assert state(tab, "moment") == "0.00"


def test_a_running_simulation_is_drawn_live(reached, running):
    sensor, data = running
    with view_live(sensor, browser=False) as viewer:
        viewer.update(data)
        tab = reached(viewer.address, "body[data-frames='1']")
        for n in range(20):
            data.mocap_pos[0] = n / 10, 0.0, 1.0
            mujoco.mj_kinematics(sensor.model, data)
            (scan,) = viewer.update(data)
            tab.wait_for_timeout(50)
        tab.wait_for_selector(f"body[data-points='{len(scan.points())}']", state="attached")
        assert int(state(tab, "frames")) >= 2
        tab.get_by_text("1.90, 0.00, 1.00 m").wait_for()


def test_a_flight_opens_on_belief_and_has_a_timeline(reached, film):
    tab = reached(film)
    assert drawn(tab) == ["observed", "paths", "robot"]
    tab.locator("#time").fill("2")
    tab.wait_for_selector("body[data-sample='2']", state="attached")
    assert "2.0 s" in tab.locator("#figures").inner_text()
    tab.get_by_role("button", name="truth").click()
    assert drawn(tab) == ["occupancy"]


def test_a_ceiling_is_cut_above_the_sensor_until_it_is_wanted(reached, film):
    tab = reached(film)
    tab.get_by_role("button", name="truth").click()
    assert state(tab, "cut") == "6"  # the sensor is in the sixth layer of voxels
    inside = tab.evaluate(PIXELS)
    tab.locator("#cut").fill("10")
    assert state(tab, "cut") == "10"
    tab.wait_for_timeout(300)
    assert tab.evaluate(PIXELS) != inside


@pytest.mark.parametrize("scheme", ["dark", "light"])
def test_a_phone_shows_the_picture_below_the_panel(reached, film, scheme):
    phone = {"viewport": {"width": 390, "height": 800}, "color_scheme": scheme}
    tab = reached(film, **phone)
    panel, picture = (tab.locator(name).bounding_box() for name in ("#panel", "#scene"))
    assert panel["y"] + panel["height"] <= picture["y"] + 1
    assert picture["width"] == 390
    assert tab.evaluate("document.body.scrollWidth") <= 390
