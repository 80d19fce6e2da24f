"""Datasets with noise, and datasets scanned again: pairs of the same worlds and poses."""

import dataclasses
import shlex
import shutil

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scenegen.cli.derive import rescan
from scenegen.dataset.rescan import plan_rescan
from scenegen.share.regenerate import check_source, source_file

from lidarsim import BeamTable, Lidar
from lidarsim.noise import VERSION
from lidarsim.noise.chain import Noise
from scenegen import GENERATOR
from scenegen.cli.options import mapping_given
from scenegen.dataset import manifest
from scenegen.dataset.build import build
from scenegen.dataset.read import Dataset
from scenegen.dataset.schema import NAME
from scenegen.errors import DatasetError, GenerationError, PublishError, RecipeError
from scenegen.recipe import preset, read_recipe
from scenegen.share.stage import Request, examine, stage
from scenegen.tables import named_lidar, named_noise
from scenegen.verification import verify
from tests.command_line import rows
from tests.conftest import COUNTS, dataset_in, small_recipe
from tests.scenegen.conftest import built, drawn_unit
from tests.scenegen.verification import forge
from tests.scenegen.verification.conftest import failed

CHAIN = "range:0.02,dropout:0.05"
SPELLED = "range:sigma_m=0.02:share=0.0:quadratic_per_m=0.0,dropout:share=0.05"


def made_with(folder, noise):
    """The dataset of `made`, with noise."""
    recipe = small_recipe(noise={"stages": noise})
    return dataset_in(folder, recipe, seed=3, counts=COUNTS, shard_samples=5)


@pytest.fixture(scope="module")
def noisy(tmp_path_factory):
    """The dataset of `made`, with noise, in other shards; not to be changed."""
    return made_with(tmp_path_factory.mktemp("noisy") / "pillar", CHAIN).folder


def test_noise_changes_ranges_alone_and_the_default_knows_nothing_of_it(made, noisy):
    plain, faulty = manifest.read(made), manifest.read(noisy)
    assert plain["version"] == 1
    assert not plain.keys() & {"noise", "labels", "rescan"}
    assert faulty["version"] == 1.2
    assert faulty["noise"] == {"stages": SPELLED, "bound_m": 4 * 0.02, "version": VERSION}
    both = (Dataset(folder).split("train") for folder in (made, noisy))
    for one, other in zip(*both, strict=True):
        for name in ("occupancy", "tudf", "position", "quaternion", "origin", "world", "viewpoint"):
            assert_array_equal(getattr(one, name), getattr(other, name))
        kept = np.isfinite(other.ranges)
        assert (kept <= np.isfinite(one.ranges)).all()
        assert 0 < np.abs(one.ranges[kept] - other.ranges[kept]).max() <= 0.08 + 1e-6


@pytest.mark.parametrize("noise", ["", CHAIN])
def test_scanned_again_it_is_to_the_bit_what_would_have_been_drawn(made, noisy, tmp_path, noise):
    chain = Noise.parse(noise) if noise else None
    plan = plan_rescan(Dataset(made), tmp_path / "again", chain=chain)
    build(plan, shard_range=(0, 3))
    (tmp_path / "again" / "train-00001.h5").unlink()
    assert not Dataset(plan.folder, partial=True).manifest.complete
    found = built(plan)
    assert found.manifest.digest == Dataset(noisy if noise else made).manifest.digest
    assert found.manifest.rescan == {"digest": Dataset(made).manifest.digest}
    assert not failed(plan.folder)
    check_source(found, *source_file(found.manifest))


@pytest.mark.usefixtures("undrawn")
def test_what_was_scanned_again_is_published_with_the_command_that_does_so(made, tmp_path):
    how = {
        "lidar": BeamTable.of(Lidar(rows=5, columns=40)),
        "chain": Noise.parse("quantise:0.1"),
        "mapping": {"scans": 2, "scan_spacing_m": 0.3, "fusion": "log-odds"},
    }
    original, out = Dataset(made), tmp_path / "out"
    build(plan_rescan(original, tmp_path / "again", **how))
    assert not failed(tmp_path / "again")
    request = Request(dataset=tmp_path / "again", repository="ada/again", out=out)
    stage(request, (("files", "all there"),))
    found, card = Dataset(out), (out / "README.md").read_text()
    assert found.manifest.lidar == how["lidar"]
    assert f"{how['lidar']}" in card
    assert (
        f"`ORIGINAL` stands for that dataset, whose digest is `{original.manifest.digest}`" in card
    )
    assert "simulated noise, `quantise:step_m=0.1`" in card
    (line,) = (line for line in card.splitlines() if line.startswith("scenegen rescan ORIGINAL"))
    with rescan.make_context("rescan", shlex.split(line)[2:]) as context:
        asked = context.params
        again = {
            "lidar": named_lidar(str(out / asked["lidar"])),
            "chain": named_noise(asked["noise"], found.lidar),
            "engine": asked["engine"],
            "mapping": mapping_given(asked),
        }
    third = build(plan_rescan(original, tmp_path / "third", **again))
    assert third.digest == found.manifest.digest
    forge.edit_manifest(tmp_path / "again", kind="my_worlds:Fence")
    examine(request)  # a kind of somebody's own need not be named, since nothing is drawn
    forge.edit_manifest(tmp_path / "again", generator=GENERATOR + 1)
    with pytest.raises(PublishError, match="would not make the same dataset again"):
        examine(request)


def test_noise_of_an_older_version_is_read_and_its_difference_reported(noisy, tmp_path):
    """A manifest that names no version of its noise is of the first one; other numbers are then
    `differs` and no fault. Here the stages differ, for numbers of that version are gone."""
    older = {"stages": SPELLED.replace("0.02", "0.019"), "bound_m": 0.076}
    folder = forge.copy(noisy, tmp_path / "d")
    forge.sign(folder, noise=older)
    assert Dataset(folder).manifest.noise == {**older, "version": 1}
    checks = {check.name: check for check in verify(folder).checks}
    assert [name for name, check in checks.items() if not check.ok] == []
    assert checks["rays"].differing
    assert "made with noise of version 1, here is version 2" in checks["rays"].detail
    with pytest.raises(PublishError, match="would not make the same dataset again"):
        check_source(Dataset(folder), *source_file(Dataset(folder).manifest))


def test_what_the_noise_cannot_have_done_is_found(noisy, tmp_path):
    folder = forge.copy(noisy, tmp_path / "d")
    weaker = {"stages": SPELLED.replace("0.02", "0.01"), "bound_m": 0.04, "version": VERSION}
    far_weaker = {"stages": "dropout:share=0.05", "bound_m": 0.0, "version": VERSION}
    for noise, check, quick in ((weaker, "rays", False), (far_weaker, "laws", True)):
        forge.edit_manifest(folder, noise=noise)
        assert check in failed(folder, quick=quick)
    forge.edit_manifest(folder, noise={"stages": SPELLED, "bound_m": 0.5})
    told = "noise.bound_m = 0.5: its stages have 0.08 with this sensor"
    assert told in failed(folder, quick=True)["manifest"]
    forge.edit_manifest(folder, noise=None, version=1)
    assert "laws" in failed(folder, quick=True)


def test_noise_that_other_software_made_is_made_again_all_the_same(noisy, tmp_path):
    folder = forge.copy(noisy, tmp_path / "d")
    software = manifest.read(folder)["software"] | {"numpy": "0.1"}
    forge.sign(folder, software=software)
    report = verify(folder)
    assert (report.ok, report.differing) == (True, ())
    assert not [check for check in report.checks if check.skipped]
    weaker = {"stages": SPELLED.replace("0.02", "0.019"), "bound_m": 0.076}
    forge.sign(folder, software=software, noise=weaker)
    differing = {check.name: check.differing for check in verify(folder).checks}
    examined = sum(COUNTS.values())  # of the small shards, all samples are
    assert differing["rays"] == {"samples": examined}
    assert differing["regenerated"]["flights"] > 0


WRONG = r"""
version       → 1                     → version = 1: expected 1.2 with noise
noise         → null                  → version = 1.2: expected 1 with nothing of a minor version
noise         → {"stages": "range"}   → noise.bound_m is missing
noise.bound_m → -1.0                  → noise.bound_m = -1.0: expected metres, or null
noise.stages  → "a\nb"                → noise.stages =
noise.version → 0                     → noise.version = 0: expected a whole number
noise         → 5                     → noise = 5: expected a table
rescan        → {"digest": "x"}       → rescan.digest
labels        → {"by": "name", "classes": ["nothing"]} → labels: expected exactly where `fields`
labels        → {"by": "name", "classes": ["box"]} → different names, "nothing" first
"""


@pytest.mark.parametrize(("path", "value", "told"), rows(WRONG))
def test_a_strangers_word_is_not_trusted(noisy, tmp_path, path, value, told):
    shutil.copy(noisy / NAME, tmp_path)
    with pytest.raises(DatasetError, match=told):
        Dataset(forge.edit_at(tmp_path, path, value))


def test_no_reader_imports_a_stage_that_a_manifest_names(noisy, tmp_path, trap):
    def copy(name, **entries):
        return forge.edit_manifest(forge.copy(noisy, tmp_path / name), **entries)

    folder = copy("data", noise={"stages": "range,trap:Stage:3", "bound_m": 0.08})
    found = Dataset(folder, partial=True)
    skipped = {check.name for check in verify(folder).checks if check.skipped}
    assert {"rays", "regenerated"} <= skipped
    with pytest.raises(PublishError, match="none of scenegen's own"):
        check_source(found, *source_file(found.manifest))
    recipe = Dataset(noisy).manifest.parameters["recipe"] | {"noise": {"stages": "trap:Stage"}}
    told = failed(copy("in", recipe=recipe), quick=True)
    assert "recipe.noise: is there" in told["manifest"]
    with pytest.raises(DatasetError, match="not imported because a manifest names it"):
        plan_rescan(Dataset(copy("engine", engine="trap:Engine")), tmp_path / "out")


FAR = """from lidarsim.noise.losses import Dropout
class Far(Dropout):
    def apply(self, returns, view, *, rng): return returns.but(ranges=returns.ranges * 3)
"""


@pytest.mark.parametrize(
    ("noise", "told"),
    [
        ("divergence:3:returns=dual", "a dataset holds one range a ray"),
        ("intensity", "a dataset holds one range a ray"),
        ("far_noise:Far", "noise stage far_noise:Far gave"),
    ],
)
def test_what_ranges_cannot_hold_is_refused_before_anything_is_written(
    tmp_path, monkeypatch, noise, told
):
    (tmp_path / "far_noise.py").write_text(FAR)
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(GenerationError, match=told):
        made_with(tmp_path / "data", noise)
    assert not (tmp_path / "data").exists()


def test_corrected_motion_is_refused_and_motion_that_bends_walls_is_not():
    rays = BeamTable.of(Lidar(rows=4, columns=30)).rays.copy()
    rays[..., 3] = np.linspace(0.0, 0.1, 30)

    def drawn(noise):
        recipe = dataclasses.replace(
            small_recipe(), lidar=BeamTable(rays=rays), noise=Noise.parse(noise)
        )
        return drawn_unit(recipe, seed=1).samples[0]

    assert (drawn("dropout:0").ranges != drawn("motion:5").ranges).mean() > 0.3
    with pytest.raises(GenerationError, match="rays begin where the scan does"):
        drawn("motion:5:corrected=true")


def test_a_recipe_says_its_noise_and_is_held_to_it(noisy, tmp_path):
    dataset = Dataset(noisy)
    name, text = source_file(dataset.manifest)
    assert f'[noise]\nstages = "{SPELLED}"' in text
    check_source(dataset, name, text)
    file = tmp_path / "it.toml"
    file.write_text(text)
    assert read_recipe(file).noise == Noise.parse(CHAIN)
    with pytest.raises(RecipeError, match=r"has a table \[noise\], and --noise"):
        read_recipe(file, noise="near")
    file.write_text('kind = "pillar"\n[noise]\nstages = "rnage:0.02"')
    with pytest.raises(RecipeError, match=r"unknown noise stage 'rnage'; did you mean"):
        read_recipe(file)
    with pytest.raises(RecipeError, match="comes with none for 'datasheet'"):
        preset("pillar", noise="datasheet")
