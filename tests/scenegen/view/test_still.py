"""Pictures: what hides what, what rays meet, and files that are images."""

import io
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.image import imread
from matplotlib.path import Path as Outline
from PIL import Image

from scenegen.dataset.read import Dataset
from scenegen.view.canvas import (
    SENSOR,
    View,
    visible_faces,
)
from scenegen.view.figures import FIGURES
from scenegen.view.look import Guess, Route
from scenegen.view.panels import to_bytes
from scenegen.view.pictures import draw_sample, draw_turn
from tests.command_line import ROOT, done, refused
from tests.scenegen import cases, refuses


@pytest.mark.parametrize("seed", range(2))
def test_the_face_painted_last_is_the_one_that_the_eye_meets_first(seed):
    """Against rays that step through the voxels from the eye."""
    rng = np.random.default_rng(seed)
    mask = rng.random((5, 4, 3)) < 0.4
    view = View(azimuth=rng.uniform(-np.pi, np.pi), elevation=rng.uniform(0.2, 1.3))
    corners, voxels, _ = visible_faces(mask, view)
    quads = view.project(corners)
    met = 0
    for spot in rng.uniform(quads.min(axis=(0, 1)), quads.max(axis=(0, 1)), (100, 2)):
        ray = (
            spot[0] * view.right
            + spot[1] * view.up
            + np.linspace(12, -12, 3001)[:, None] * view.eye
        )
        cells = np.floor(ray).astype(int)
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


def test_a_sample_becomes_a_picture_with_its_sensor(look, monkeypatch):
    monkeypatch.setattr("scenegen.view.panels.DPI", 60)
    less = replace(look, tudf=None, masks={"observed": look.masks["observed"]})
    image, poorer = drawn(draw_sample(look)), drawn(draw_sample(less))
    assert image.shape[1] == round(60 * 12.5875)
    assert (np.abs(image * 255 - SENSOR).max(axis=2) < 3).sum() > 40
    assert (poorer == 1).all(axis=2).mean() > (image == 1).all(axis=2).mean()


def test_the_command_draws_samples_sheets_and_worlds(made, standing, capsys, monkeypatch):
    monkeypatch.setattr("scenegen.view.pictures.PIXELS", 200)
    monkeypatch.setattr("scenegen.view.panels.DPI", 50)
    room = ROOT / "scenes" / "room_with_gap.xml"
    picture = standing / "deep" / "x.png"
    for words in (
        f"{made} --index 2",
        f"{made} --sheet 5 --split test",
        f"{made} --index 1 --figure world",
        f"{room} --flight",
    ):
        done(capsys, f"render {words} -o {picture} --quiet")
        assert picture.read_bytes().startswith(b"\x89PNG")
        picture.unlink()
    for words, part in cases("view/still"):
        assert part in refused(capsys, f"render {words.replace('MADE', str(made))}")
    assert not list(standing.glob("x.*"))


def test_a_figure_for_a_paper_is_as_wide_and_its_letters_are_letters(made, tmp_path, capsys):
    picture = tmp_path / "x.svg"
    done(capsys, f"render {made} --paper one --font-size 6 -o {picture} --quiet")
    text = picture.read_text(encoding="utf-8")
    assert f'width="{88 / 25.4 * 72:.6f}pt"' in text
    assert ">observed</text>" in text
    assert text.count("<image") >= 5  # points, voxels and distances


def test_a_flight_is_a_film_of_its_samples(made, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("scenegen.view.pictures.TURN_DPI", 40)
    done(capsys, f"render {made} --index 1 --flight -o {tmp_path}/x.gif --quiet")
    worlds = [world for _, world, _ in Dataset(made).split("train").names]
    with Image.open(tmp_path / "x.gif") as film:
        assert (film.format, film.n_frames) == ("GIF", worlds.count(worlds[1]))


def test_a_turntable_turns_once_around(look, monkeypatch):
    monkeypatch.setattr("scenegen.view.pictures.TURN_DPI", 40)
    with Image.open(io.BytesIO(draw_turn(look, title="small", frames=4))) as film:
        assert (film.format, film.n_frames, film.size) == ("WEBP", 4, (256, 192))
        shown = []
        for n in range(4):
            film.seek(n)
            shown.append(np.asarray(film.convert("RGB")).astype(int))
    differ = [(np.abs(one - shown[0]).max(axis=2) > 60).mean() for one in shown]
    assert differ[0] == 0
    assert min(differ[1:]) > 0.02


def predicted(look):
    """A sample of which the upper half is missed, and a block is invented, with a path through the
    map."""
    truth = look.masks["occupancy"]
    guess = truth.copy()
    guess[:, :, truth.shape[2] // 2 :] = False
    guess[-4:, :4, -4:] = True
    ends = np.add(look.origin, [[0.5, 0.5, 0.5], [4.0, 4.0, 2.5]])
    tudf = np.zeros(truth.shape, np.float32)
    route = Route(start=ends[0], goal=ends[1], points=ends, told="")
    occ = Guess(name="occ", occupied=guess, tudf=tudf, route=route)
    own = replace(occ, name="$own$", route=replace(route, points=np.add(ends, [0, 0, 1])))
    return replace(look, guesses=(occ, own))


@pytest.mark.parametrize("name", list(FIGURES))
def test_the_paper_s_figures_show_what_methods_predict(look, name, monkeypatch):
    """Right completions, no distances and no paths make another page."""
    monkeypatch.setattr("scenegen.view.panels.DPI", 60)
    look = predicted(look)
    other = replace(look.guesses[0], occupied=look.masks["occupancy"], tudf=look.tudf)
    other = replace(other, route=replace(other.route, points=None))

    def page(*guesses):
        return drawn(FIGURES[name]([replace(look, guesses=guesses)], title=""))

    one, two = page(*look.guesses), page(other, look.guesses[1])
    assert one.shape == two.shape
    assert 0.0005 < (np.abs(one - two).max(axis=2) > 0.1).mean() < 0.5
    refuses("--weights", page)
