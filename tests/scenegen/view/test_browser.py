"""The page in a real browser: needs Chromium and playwright, which is in none of our extras."""

import shutil

import numpy as np
import pytest

from scenegen.view.look import Guess, Route
from tests.scenegen.view.test_live import served
from tests.scenegen.view.test_page import HOSTILE

pytestmark = pytest.mark.slow
CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
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


def wait_until(tab, attribute):
    """Wait until the page's body has an attribute."""
    tab.wait_for_selector(f"body[data-{attribute}]", state="attached", timeout=60_000)


def reached(browser, address, first=0):
    """The page at an address once its first sample shows, and the list of what its console says
    against it, and of requests to other places."""
    complaints = []
    allowed = address.partition("#")[0], "blob:"

    def on_request(request):
        if not request.url.startswith(allowed):
            complaints.append(request.url)

    tab = browser.new_page(viewport={"width": 900, "height": 700})
    tab.on("console", lambda line: line.type == "error" and complaints.append(line.text))
    tab.on("pageerror", lambda error: complaints.append(str(error)))
    tab.on("dialog", lambda dialog: complaints.append("dialog") or dialog.dismiss())
    tab.on("request", on_request)
    tab.goto(address)
    wait_until(tab, f"sample='{first}'")
    return tab, complaints


def state(tab, name):
    """What a page says of itself."""
    return tab.evaluate(f"document.body.dataset.{name}")


def test_the_address_keeps_what_is_shown_and_a_click_picks_a_voxel(browser, made):
    with served(made) as server:
        place = f"{server.address}#sample=2&split=train&layers=occupancy~free"
        tab, complaints = reached(browser, place, first=2)
        assert state(tab, "layers").split()[-2:] == ["free", "occupancy"]
        box = tab.locator("canvas#scene").bounding_box()
        for across, down in np.ndindex(6, 6):
            x, y = 0.55 + 0.05 * across, 0.4 + 0.05 * down
            tab.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])
            if voxel := tab.locator("#picked").inner_text():
                break
        assert "occupancy" in voxel or "free" in voxel
        assert " m." in voxel
        with tab.expect_download() as saved:
            tab.get_by_role("button", name="PNG").click()
        assert saved.value.suggested_filename == "sample-2.png"
        tab.keyboard.press("ArrowRight")
        tab.wait_for_url("**#sample=3&*")
        assert complaints == []


def guesses(samples, index):
    sample = samples[index]
    ends = sample.origin + np.array([[1.0, 1.0, 1.0], [3.0, 3.0, 2.0]])
    route = Route(start=ends[0], goal=ends[1], points=ends, told="2.9 m")
    return [Guess(name=HOSTILE, occupied=sample.observed, tudf=sample.tudf, route=route)]


def test_the_viewer_steps_through_datasets_and_splits_and_names_what_is_damaged(
    browser, made, dataset
):
    (dataset / "train-00001.h5").unlink()  # samples 3 to 5
    with served(dataset, made, index=2, guesses=guesses, methods=(HOSTILE,)) as server:
        tab, complaints = reached(browser, server.address, first=2)
        tab.get_by_role("button", name="errors").click()
        for label in ("world", "missed", "distances"):
            tab.get_by_label(label, exact=True).check()
        wait_until(tab, "layers~='world'")
        for layer in ("paths", "observed", "invented", "missed", f"{HOSTILE}: distances"):
            assert layer in state(tab, "layers")
        assert "2.9 m" in tab.locator("#figures").inner_text()
        tab.locator("canvas#scene").click()
        for key, sample, note in (("ArrowRight", 3, "train-00001.h5"), ("End", 10, "")):
            tab.keyboard.press(key)
            wait_until(tab, f"sample='{sample}'")
            assert note in tab.locator("#notes").inner_text()
        tab.locator("#split").select_option("test")
        wait_until(tab, "sample='0'")
        tab.locator("#number").fill("1")
        tab.locator("#number").press("Enter")
        wait_until(tab, "sample='1'")
        tab.locator("#dataset").select_option(index=1)
        wait_until(tab, "sample='0'")
        assert int(state(tab, "milliseconds")) < 2000
        assert [line for line in complaints if "404" not in line] == []


PIXELS = """() => {
  const [canvas, count] = [document.querySelector("#scene"), +document.body.dataset.views];
  const wide = Math.floor(canvas.clientWidth / count);
  return Array.from({ length: count }, (_, n) => {
    const copy = Object.assign(document.createElement("canvas"), { width: wide, height: 700 });
    copy.getContext("2d").drawImage(canvas, -n * wide, 0);
    return copy.toDataURL();
  });
}"""


def test_views_side_by_side_have_one_camera(browser, made):
    """Views of the same layer are the same picture, however it is turned; the address keeps
    them."""
    with served(made) as server:
        place = f"{server.address}#layers=rays&views=observed~observed~occupancy"
        tab, complaints = reached(browser, place)
        seen = set()
        for across in (500, 560):
            tab.mouse.move(500, 300)
            tab.mouse.down()
            tab.mouse.move(across, 300)
            tab.mouse.up()
            tab.wait_for_timeout(500)
            left, same, other = tab.evaluate(PIXELS)
            assert left == same != other
            seen.add(left)
        assert len(seen) == 2
        tab.get_by_label("view 2").select_option("free")
        tab.wait_for_url("**views=observed%7Efree%7Eoccupancy*")
        assert "free" in state(tab, "layers")
        tab.get_by_role("button", name="truth").click()
        assert (state(tab, "views"), complaints) == ("1", [])
