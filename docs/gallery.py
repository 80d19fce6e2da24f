"""Draw the sheets of all sensors and of all stages of noise, or the pictures of docs/look.md and
docs/sensor.md.

    python docs/gallery.py          # docs/pictures/gallery/*.webp
    python docs/gallery.py sensors  # docs/pictures/sensors/*.png
    python docs/gallery.py look     # docs/pictures/look/*.webp, of data/geometric and data/pillar
    python docs/gallery.py page     # those of the page in a browser: `pip install playwright`, and
                                    # Debian's chromium
    python docs/gallery.py report   # that of the bench's page, by both, too

`data/geometric` and `data/pillar` are those of `scenegen generate --kind …`; `data/moving` is that
of `scenegen generate --kind street --movers dense --scans 3`.
"""

import io
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from PIL import Image

from lidarsim import Pose
from lidarsim.noise import STAGES
from lidarsim.noise.chain import Noise
from lidarsim.sensors import CATALOGUE, RASTER
from lidarsim.sensors.device import angles_deg
from scenegen.draw.draw import scan_world
from scenegen.draw.source import read_world
from scenegen.view.canvas import DISTANCES, colour
from scenegen.view.stills import draw_patterns, to_bytes
from scenegen.worlds.tables import named_lidar

DOCS = Path(__file__).parent
SHEETS = DOCS / "pictures" / "gallery"
SCENE = DOCS.parent / "scenes" / "warehouse.xml"
POSE = Pose.level((8.0, 6.0, 1.5), np.radians(30))
FAR_M = 20.0
"""What is farther has the last colour, metres."""
SCALE = ListedColormap(colour(np.linspace(0, 1, 256), DISTANCES))
SHOWN = {
    "motion": "motion:8:yaw_rate_deg_s=180",
    "divergence": "divergence:20",
    "near": "near:5",
    "range": "range:0.15",
    "depth": "depth:0.01",
    "quantise": "quantise:0.5",
    "dropout": "dropout:0.4",
    "far": "far:1:power=1",
    "grazing": "grazing:50",
    "faint": "faint:10",
    "spurious": "spurious:0.03",
    "intensity": "intensity:0.05",
}
"""Every stage, stronger than a sensor has it, so that it is seen."""
NETWORKS = "--weights tudf --weights occ --weights proposed"
LOOKS = {
    "sample": (1000, "data/geometric --split test --index 437"),
    "sheet": (1000, "data/geometric --sheet 8"),
    "completions": (1300, f"data/geometric --split test --index 7 {NETWORKS}"),
    "paths": (
        1100,
        "data/geometric --split test --figure paths --index 499 --index 299 --index 7 "
        f"{NETWORKS} --weights columns",
    ),
    "example": (1300, f"data/geometric --split test --index 7 --figure example {NETWORKS}"),
    "archived": (800, "data/pillar --split test --index 7 --figure world"),
    "flight": (800, "scenes/warehouse.xml --flight"),
}
"""Width in pixels of each of docs/look.md's pictures, and what `scenegen render` is told."""
FIRST, WHOSE = "sample=7&split=test", "proposed"
TABS = {
    "page": (800, "data/geometric", NETWORKS, ""),
    "predicted": (
        800,
        "data/geometric",
        NETWORKS,
        f"&layers={WHOSE}~{WHOSE}: missed~{WHOSE}: invented~paths",
    ),
    "beside": (520, "data/geometric", NETWORKS, f"&layers=paths&views=observed~{WHOSE}~occupancy"),
    "world": (800, "data/pillar", "", "&layers=points~occupancy~world"),
    "movers": (800, "data/moving", "", ""),
}
"""The height in pixels, the dataset, the networks and the address of each picture of the page."""


def main() -> None:
    """Draw the sheets."""
    world = read_world(SCENE)
    SHEETS.mkdir(parents=True, exist_ok=True)
    for name, figure in (("sensors", sensors(world)), ("noise", noise(world))):
        (SHEETS / f"{name}.webp").write_bytes(to_bytes(figure, ".webp"))


def draw_looks() -> None:
    """Draw the pictures of docs/look.md by the commands that stand there."""
    with tempfile.TemporaryDirectory() as folder:
        for name, (wide, words) in LOOKS.items():
            drawn = Path(folder, f"{name}.png")
            subprocess.run(["scenegen", "render", *words.split(), "-o", drawn], check=True)
            with Image.open(drawn) as picture:
                small(picture, wide, f"{name}.webp")


def small(picture: Any, wide: int, name: str) -> None:
    """Write one of docs/look.md's pictures, so many pixels wide."""
    size = wide, round(picture.height * wide / picture.width)
    drawn = picture.convert("RGB").resize(size, Image.Resampling.LANCZOS)
    drawn.save(DOCS / "pictures" / "look" / name, quality=70, method=6)


@contextmanager
def chromium() -> Iterator[Any]:
    """A tab of Chromium with its software renderer."""
    from playwright.sync_api import sync_playwright

    flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=flags)
        yield browser.new_page()
        browser.close()


def draw_report() -> None:
    """Take the picture of the begin of the bench's page."""
    words = ["bench", "data/pillar", "--quick", "--quiet", *NETWORKS.split()]
    with tempfile.TemporaryDirectory() as folder, chromium() as tab:
        subprocess.run(["scenegen", *words, "-o", folder], check=True)
        tab.set_viewport_size({"width": 1280, "height": 980})
        tab.goto(Path(folder, "report.html").as_uri())
        small(Image.open(io.BytesIO(tab.screenshot())), 900, "report.webp")


def draw_page() -> None:
    """Take the pictures of what `scenegen view` serves."""
    with chromium() as tab:
        for name, (height, data, networks, place) in TABS.items():
            tab.set_viewport_size({"width": 1160, "height": height})
            words = ["scenegen", "view", data, "--port", "0", *networks.split()]
            server = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
            assert server.stdout is not None
            tab.goto(f"{server.stdout.readline().split()[0]}#{FIRST}{place}")
            tab.wait_for_selector("body[data-sample='7']", state="attached", timeout=60_000)
            tab.wait_for_timeout(3000)  # the world is asked for after the sample
            small(Image.open(io.BytesIO(tab.screenshot())), 900, f"{name}.webp")
            server.terminate()
            server.wait()
            tab.goto("about:blank")


def draw_sensors() -> None:
    """Draw the pattern of every sensor of the catalogue, as `scenegen sensors NAME --out` does."""
    for name in CATALOGUE:
        drawn = io.BytesIO(to_bytes(draw_patterns({name: named_lidar(name)}), ".png"))
        picture = Image.open(drawn).convert("RGB").quantize(64, dither=Image.Dither.NONE)
        picture.save(DOCS / "pictures/sensors" / f"{name}.png", optimize=True)


def panels(count: int, columns: int, size: tuple[float, float]) -> tuple[Figure, list[Any]]:
    """A sheet of so many panels without axes, inches each."""
    rows = -(-count // columns)
    figure = Figure(figsize=(columns * size[0], rows * size[1]), dpi=90, layout="constrained")
    every = list(figure.subplots(rows, columns, squeeze=False).flat)
    for panel in every:
        panel.set(xticks=[], yticks=[])
    for panel in every[count:]:
        panel.remove()
    return figure, every[:count]


def sensors(world: Any) -> Figure:
    """Every sensor's returns by their angles, coloured by range."""
    names = (RASTER, *CATALOGUE)
    figure, every = panels(len(names), 3, (4.2, 1.7))
    for panel, name in zip(every, names, strict=True):
        lidar = named_lidar(name)
        ranges = scan_world(world, lidar, POSE, seed=0).ranges.reshape(-1)
        up, around = angles_deg(lidar.directions_body.reshape(-1, 3))
        hit = np.isfinite(ranges)
        panel.scatter(around[hit], up[hit], s=0.3, c=ranges[hit], cmap=SCALE, vmin=0, vmax=FAR_M)
        panel.set(xlim=(180, -180), ylim=(-60, 60))
        panel.set_title(name, fontsize=9)
    return figure


def noise(world: Any) -> Figure:
    """Every stage's returns from above, over the clean ones in grey; metres."""
    assert set(SHOWN) == set(STAGES.builtin), "a stage of noise is not shown"
    lidar = named_lidar("velodyne-vlp-16")
    figure, every = panels(len(SHOWN), 4, (3.2, 2.6))
    clean = scan_world(world, lidar, POSE, seed=0).points()
    for panel, text in zip(every, SHOWN.values(), strict=True):
        seen = scan_world(world, lidar, POSE, Noise.parse(text), seed=0)
        points = seen.points()
        value = np.linalg.norm(points - POSE.position, axis=1) / FAR_M
        if seen.intensity is not None:
            value = seen.intensity[np.isfinite(seen.ranges)]
        panel.scatter(*clean[:, :2].T, s=0.2, color="0.75")
        panel.scatter(*points[:, :2].T, s=0.3, c=value, cmap=SCALE, vmin=0, vmax=1)
        low, high = clean[:, :2].min(0) - 1, clean[:, :2].max(0) + 1
        panel.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        panel.set_title(text, fontsize=9)
    return figure


if __name__ == "__main__":
    parts = {"sensors": draw_sensors, "look": draw_looks, "page": draw_page, "report": draw_report}
    parts.get(" ".join(sys.argv[1:]), main)()
