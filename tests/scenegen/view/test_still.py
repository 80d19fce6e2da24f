"""Pictures: what hides what, what rays meet, and files that are images."""

import io
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.image import imread
from matplotlib.path import Path as Outline
from PIL import Image
from scenegen.view.figures import FIGURES
from scenegen.view.panels import to_bytes
from scenegen.view.pictures import draw_sample, draw_turn

from scenegen.base.errors import ScenegenError
from scenegen.dataset.read import Dataset
from scenegen.view.canvas import SENSOR, View, visible_faces
from scenegen.view.look import Guess, Route
from tests.command_line import ROOT, done, refused
from tests.refusals import refuses
from tests.scenegen import cases


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """Pictures of few pixels."""
    monkeypatch.setattr("scenegen.view.pictures.PIXELS", 200)
    monkeypatch.setattr("scenegen.view.pictures.TURN_DPI", 40)
    monkeypatch.setattr("scenegen.view.panels.DPI", 60)


@pytest.fixture
def here(standing, made):
    """A folder to stand in, with a dataset and a scene."""
    (standing / "made").symlink_to(made)
    (standing / "room.xml").symlink_to(ROOT / "scenes" / "room_with_gap.xml")
    return standing


@pytest.mark.parametrize("seed", range(2))
def test_the_face_painted_last_is_the_one_that_the_eye_meets_first(seed):
    """Against rays that step through the voxels from the eye."""
    rng = np.random.default_rng(seed)
    mask = rng.random((5, 4, 3)) < 0.4
    view = View(azimuth=rng.uniform(-np.pi, np.pi), elevation=rng.uniform(0.2, 1.3))
    corners, voxels, _ = visible_faces(mask, view)
    quads = view.project(corners)
    depths = np.linspace(12, -12, 3001)[:, None]
    met = 0
    for spot in rng.uniform(quads.min(axis=(0, 1)), quads.max(axis=(0, 1)), (100, 2)):
        cells = np.floor(spot[0] * view.right + spot[1] * view.up + depths * view.eye).astype(int)
        inside = ((cells >= 0) & (cells < mask.shape)).all(axis=1)
        hits = [tuple(cell) for cell in cells[inside] if mask[tuple(cell)]]
        painted = [n for n, quad in enumerate(quads) if Outline(quad).contains_point(spot)]
        assert bool(hits) == bool(painted)
        if hits:
            met += 1
            assert tuple(voxels[painted[-1]]) == hits[0]
            assert np.abs(corners[painted[-1]].mean(axis=0) - np.array(hits[0]) - 0.5).max() <= 0.5
    assert met > 30


def drawn(figure):
    """Its pixels, from 0 to 1."""
    return imread(io.BytesIO(to_bytes(figure, ".png")), format="png")[..., :3]


def test_a_sample_becomes_a_picture_with_its_sensor(look):
    less = replace(look, tudf=None, masks={"observed": look.masks["observed"]})
    image, poorer = drawn(draw_sample(look)), drawn(draw_sample(less))
    assert image.shape[1] == round(60 * 12.5875)
    assert (np.abs(image * 255 - SENSOR).max(axis=2) < 3).sum() > 40
    assert (poorer == 1).all(axis=2).mean() > (image == 1).all(axis=2).mean()


@pytest.mark.parametrize(
    "words", ["made --sheet 5 --split test", "made --index 1 --figure world", "room.xml --flight"]
)
def test_the_command_draws_sheets_and_worlds(words, here, capsys):
    done(capsys, f"render {words} -o deep/x.png --quiet")
    assert (here / "deep/x.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(("words", "fault"), cases("view/still"))
def test_what_cannot_be_drawn_ends_in_one_line(words, fault, here, capsys):
    assert fault in refused(capsys, f"render {words}")
    assert not list(here.glob("x.*"))


def test_a_figure_for_a_paper_is_as_wide_and_its_letters_are_letters(here, capsys):
    done(capsys, "render made --paper one --font-size 6 -o x.svg --quiet")
    text = (here / "x.svg").read_text(encoding="utf-8")
    assert f'width="{88 / 25.4 * 72:.6f}pt"' in text
    assert ">observed</text>" in text
    assert text.count("<image") >= 5  # points, voxels and distances


def test_a_flight_is_a_film_of_its_samples(here, made, capsys):
    done(capsys, "render made --index 1 --flight -o x.gif --quiet")
    worlds = [world for _, world, _ in Dataset(made).split("train").names]
    with Image.open(here / "x.gif") as film:
        assert (film.format, film.n_frames) == ("GIF", worlds.count(worlds[1]))


def test_a_turntable_turns_once_around(look):
    with Image.open(io.BytesIO(draw_turn(look, title="small", frames=4))) as film:
        assert (film.format, film.n_frames, film.size) == ("WEBP", 4, (256, 192))
        shown = []
        for n in range(4):
            film.seek(n)
            shown.append(np.asarray(film.convert("RGB")).astype(int))
    differ = [(np.abs(image - shown[0]).max(axis=2) > 60).mean() for image in shown]
    assert differ[0] == 0
    assert min(differ[1:]) > 0.02


def predicted(look):
    """A sample of which the upper half is missed, and a block is invented, with a path through the
    map."""
    occupied = look.masks["occupancy"].copy()
    occupied[:, :, occupied.shape[2] // 2 :] = False
    occupied[-4:, :4, -4:] = True
    ends = np.add(look.origin, [[0.5, 0.5, 0.5], [4.0, 4.0, 2.5]])
    route = Route(start=ends[0], goal=ends[1], points=ends, told="")
    occ = Guess(name="occ", occupied=occupied, tudf=np.zeros_like(look.tudf), route=route)
    own = replace(occ, name="$own$", route=replace(route, points=np.add(ends, [0, 0, 1])))
    return replace(look, guesses=(occ, own))


@pytest.mark.parametrize("name", list(FIGURES))
def test_the_papers_figures_show_what_methods_predict(look, name):
    """Right completions, no distances and no paths make another page."""
    look = predicted(look)
    guess, own = look.guesses
    route = replace(guess.route, points=None)
    right = replace(guess, occupied=look.masks["occupancy"], tudf=look.tudf, route=route)

    def page(*guesses):
        return drawn(FIGURES[name]([replace(look, guesses=guesses)], title=""))

    image, other = page(guess, own), page(right, own)
    assert image.shape == other.shape
    assert 0.0005 < (np.abs(image - other).max(axis=2) > 0.1).mean() < 0.5
    refuses(name, page, error=ScenegenError)
