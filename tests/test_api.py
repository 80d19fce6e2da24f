"""What `scenegen` offers goes together: from a dataset that is made to one that is checked, shown
and measured."""

import shutil

import numpy as np
import pytest

import scenegen
from scenegen.base.errors import DatasetError, ScenegenError
from tests.command_line import ROOT, python
from tests.refusals import refuses


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("api") / "d"
    recipe = scenegen.preset("pillar")
    return scenegen.generate(recipe=recipe, n=np.int64(2), val=0, test=2, out=folder, seed=3)


def test_a_dataset_is_made_loaded_and_checked(dataset):
    sample = scenegen.load(dataset, "test")[0]
    drawn = scenegen.stream("pillar", seed=3, split="test")[0]
    assert drawn.sha256() == sample.sha256()
    assert scenegen.verify(dataset.folder, quick=True).ok


@pytest.mark.parametrize(("name", "value"), [("n", "5"), ("val", 10**12), ("workers", 0)])
def test_what_cannot_be_generated_leaves_nothing(name, value, tmp_path):
    options = {"n": 2, "out": tmp_path / "d", name: value}
    refuses(name, scenegen.generate, "pillar", **options, error=ScenegenError)
    assert not (tmp_path / "d").exists()


def test_samples_are_shown(dataset, tmp_path):
    sample = dataset.split("train")[0]
    guess = scenegen.Prediction(occupancy_probability=sample.observed.astype(np.float32))
    path = np.linspace(sample.origin, sample.position, 5)
    shown = scenegen.show(sample, {"<mine>": guess}, path, out=tmp_path / "page.html")
    assert "\\u003cmine>" in (tmp_path / "page.html").read_text(encoding="utf-8")
    assert f"{np.linalg.norm(sample.position - sample.origin):.2f} m" in shown.html
    framed = shown._repr_html_()
    assert framed.startswith("<div")
    assert not [raw for raw in ("<script", "<mine>") if raw in framed]
    assert "data:image/png" in framed


def test_what_cannot_be_shown_is_refused(dataset):
    sample = dataset.split("train")[0]
    bare = scenegen.Sample(**{name: getattr(sample, name) for name in sample.names})
    for case, *arguments in (
        ("distances", sample, sample.tudf),
        ("NaN", sample, scenegen.Prediction(tudf=sample.tudf * np.nan)),
        ("a point", sample, {}, sample.position),
        ("no grid", bare),
        ("none", []),
    ):
        refuses(case, scenegen.show, *arguments, error=DatasetError)


@pytest.mark.checkout
def test_a_checkout_without_links_works(tmp_path):
    """A zip, and a checkout on Windows, has a text file in the link's place."""
    for part in ("lidarsim", "scenegen", "model"):
        left = shutil.ignore_patterns("__pycache__", "*.safetensors", "three")
        shutil.copytree(ROOT / part, tmp_path / part, symlinks=True, ignore=left)
    link = tmp_path / "scenegen" / "model"
    assert link.is_symlink()
    link.unlink()
    link.write_text("../model")
    code = "import scenegen.model.config as it, scenegen; print(it.__file__, scenegen.Prediction)"
    assert python("-c", code, cwd=tmp_path).stdout.startswith(str(tmp_path / "model" / "config.py"))
