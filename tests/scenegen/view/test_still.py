"""Pictures: what hides what, what panels, captions and legends hold, and files that are images."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.path import Path as Outline

from scenegen.base.errors import ScenegenError
from scenegen.view.blocks import EYE, RIGHT, project, visible_faces
from scenegen.view.canvas import Paper
from scenegen.view.look import Guess, PlannedPath
from scenegen.view.stills import VEIL, draw
from tests.command_line import ROOT, done, refused
from tests.refusals import refuses
from tests.scenegen import each_case

ERRORS = {"missed (pale: one voxel off)", "invented (pale: one voxel off)"}
PATHS = {"occ", "$own$", "start", "goal", "meets an obstacle"}
COLUMNS = ["scan", "truth", "occ", "$own$"]
FIGURES = {
    "completions": (COLUMNS, {"sensor", *ERRORS, "unknown", "free"}),
    "distances": (COLUMNS, {"sensor", "unknown", "free"}),
    "paths": ([], PATHS),
    "example": (["occ", "$own$", "truth"], PATHS),
}
"""Columns and legends."""


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """Pictures of few pixels."""
    monkeypatch.setattr("scenegen.view.stills.DPI", 60)


@pytest.fixture
def here(standing, made):
    """A folder to stand in, with a dataset and a scene."""
    (standing / "made").symlink_to(made)
    (standing / "room.xml").symlink_to(ROOT / "scenes" / "room_with_gap.xml")
    return standing


@pytest.mark.parametrize("seed", range(2))
def test_the_face_painted_last_is_met_first(seed):
    """Against rays that step through the voxels from the eye."""
    rng = np.random.default_rng(seed)
    mask = rng.random((5, 4, 3)) < 0.4
    corners, voxels, _ = visible_faces(mask)
    quads = project(corners)
    depths = np.linspace(12, -12, 24_001)[:, None]
    met = 0
    for spot in rng.uniform(quads.min(axis=(0, 1)), quads.max(axis=(0, 1)), (100, 2)):
        place = spot[0] * RIGHT + spot[1] * np.cross(EYE, RIGHT)
        cells = np.floor(place + depths * EYE).astype(int)
        cells = cells[((cells >= 0) & (cells < mask.shape)).all(axis=1)]
        hits = cells[mask[tuple(cells.T)]]
        painted = [n for n, quad in enumerate(quads) if Outline(quad).contains_point(spot)]
        assert bool(len(hits)) == bool(painted)
        if painted:
            met += 1
            assert tuple(voxels[painted[-1]]) == tuple(hits[0])
            assert np.abs(corners[painted[-1]].mean(axis=0) - hits[0] - 0.5).max() <= 0.5
    assert met > 30


def test_inner_faces_are_left_out():
    whole = np.ones((3, 3, 3), bool)
    inner = np.zeros_like(whole)
    inner[1, 1, 1] = True
    assert len(visible_faces(whole)[0]) == 3 * 9
    assert len(visible_faces(inner, ~inner)[0]) == 3 * 9 + 3  # a veil hides nothing


def predicted(look):
    """A sample of which the upper half is missed, and a block is invented, with a path through the
    map."""
    occupied = look.masks["occupancy"].copy()
    occupied[:, :, occupied.shape[2] // 2 :] = False
    occupied[-4:, :4, -4:] = True
    ends = np.add(look.origin, [[0.5, 0.5, 0.5], [4.0, 4.0, 2.5]])
    route = PlannedPath(start=ends[0], goal=ends[1], points=ends, told="", hit=ends[1])
    occ = Guess(name="occ", occupied=occupied, tudf=np.zeros_like(look.tudf), route=route)
    own = replace(occ, name="$own$", route=replace(route, points=np.add(ends, [0, 0, 1])))
    return replace(look, guesses=(occ, own))


def texts(figure):
    """What stands above and beside its panels, below them, and in its legend."""
    (legend,) = figure.legends
    every = [figure.get_suptitle(), *(axes.get_title() for axes in figure.axes)]
    names = [name for name in [*every, *(axes.get_ylabel() for axes in figure.axes)] if name]
    captions = [axes.get_xlabel() for axes in figure.axes]
    return names, captions, {text.get_text() for text in legend.get_texts()}


def test_a_sample_has_its_levels_below(look):
    level = look.origin[2] + look.grid.voxel_m * (look.grid.shape[2] // 2 - 0.5)
    names, captions, legend = texts(draw([look], title="a $ample"))
    assert names == ["a $ample", "scan", "observed", "truth"]
    assert captions[3:5] == [f"{what}, z {level:.2f} m" for what in ("known", "distance")]
    assert legend == {"sensor", "unknown", "free"}


def test_parts_that_cannot_be_read_are_left_out(look):
    poorer = replace(look, tudf=None, masks={"free": look.masks["free"]})
    assert texts(draw([predicted(look), replace(poorer, guesses=predicted(look).guesses)]))
    refuses("no part", draw, [replace(poorer, scans=())], error=ScenegenError)


@pytest.mark.parametrize("figure", FIGURES)
def test_figures_name_what_they_show(look, figure):
    look = predicted(look)
    names, captions, legend = texts(draw([look], figure))
    assert (names, legend) == FIGURES[figure]
    expected = [look.iou(guess) for guess in look.guesses]
    shown = [text for text in captions if text.startswith("IoU")]
    assert shown == expected * (figure in ("completions", "example"))


@pytest.mark.parametrize("figure", FIGURES)
def test_nothing_predicted_is_no_figure(look, figure):
    refuses(figure, draw, [look], figure, error=ScenegenError)


def test_rows_are_named_and_change_places(look):
    looks = [replace(predicted(look), name=name) for name in ("first", "last")]
    assert texts(draw(looks))[0] == [*COLUMNS, "first", "last"]
    assert texts(draw(looks, paper=Paper(3.0)))[0] == ["first", "last", *COLUMNS]


def test_unknown_voxels_are_a_veil(look):
    known = np.arange(look.grid.shape[0])[:, None, None] < np.full(look.grid.shape, 9)
    panel = draw([replace(look, known=known, scans=(), tudf=None)]).axes[0]
    parts = (part for part in panel.collections if isinstance(part, PolyCollection))
    faces = max((part.get_facecolor() for part in parts), key=len)
    truth = look.masks["occupancy"] & known
    count, veiled = (len(visible_faces(truth, *veil)[0]) for veil in ((), (~known,)))
    assert (faces[:, 3] == VEIL[3]).sum() == veiled - count


@pytest.mark.parametrize(
    "words",
    [
        "made --sheet 5 --split test",
        "made --index 1 --figure world",
        "room.xml --flight",
        "room.xml --paper one",
    ],
)
def test_the_command_draws_sheets_and_worlds(words, here, capsys):
    done(capsys, f"render {words} -o deep/x.png --quiet")
    assert (here / "deep/x.png").read_bytes().startswith(b"\x89PNG")


@each_case("view/still", "words fault")
def test_what_cannot_be_drawn_ends_in_one_line(words, fault, here, capsys):
    assert fault in refused(capsys, f"render {words}")
    assert not list(here.glob("x.*"))


def test_a_figure_for_a_paper_is_as_wide_and_its_letters_are_letters(here, capsys):
    done(capsys, "render made --paper one --font-size 6 -o x.svg --quiet")
    text = (here / "x.svg").read_text(encoding="utf-8")
    assert f'width="{88 / 25.4 * 72:.6f}pt"' in text
    assert ">observed</text>" in text
