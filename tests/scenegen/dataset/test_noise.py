"""Datasets with noise, and datasets scanned again: pairs of the same worlds and poses."""

import dataclasses
import json
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from lidarsim import BeamTable, Lidar
from lidarsim.noise.chain import Noise
from scenegen import GENERATOR
from scenegen.cli.derive import rescan
from scenegen.cli.options import mapping_given
from scenegen.dataset.build import build
from scenegen.dataset.manifest import NAME
from scenegen.dataset.read import Dataset
from scenegen.dataset.rescan import plan_rescan
from scenegen.draw import draw_unit
from scenegen.errors import DatasetError, GenerationError, PublishError, RecipeError
from scenegen.recipe import preset, read_recipe
from scenegen.share.regenerate import check_source, source_file
from scenegen.share.stage import Request, examine, stage
from scenegen.source import DrawnWorlds
from scenegen.tables import named_lidar, named_noise
from scenegen.verification import verify
from tests.conftest import COUNTS, dataset_in, small_recipe
from tests.scenegen.verification.conftest import failed

CHAIN = "range:0.02,dropout:0.05"
SPELLED = "range:sigma_m=0.02:share=0.0:quadratic_per_m=0.0,dropout:share=0.05"


def made_with(folder, noise, *, counts=None, shard_samples=5):
    """The dataset of `made`, with noise."""
    recipe = dataclasses.replace(small_recipe(), noise=Noise.parse(noise))
    counts = counts or COUNTS
    return dataset_in(folder, recipe, seed=3, counts=counts, shard_samples=shard_samples)


@pytest.fixture(scope="module")
def noisy(tmp_path_factory):
    """The dataset of `made`, with noise, in other shards; not to be changed."""
    folder = tmp_path_factory.mktemp("noisy") / "pillar"
    made_with(folder, CHAIN)
    return folder


def test_noise_changes_ranges_alone_and_the_default_knows_nothing_of_it(made, noisy):
    plain, faulty = json.loads((made / NAME).read_text()), json.loads((noisy / NAME).read_text())
    assert plain["version"] == 1
    assert not plain.keys() & {"noise", "labels", "rescan"}
    assert faulty["version"] == 1.2
    assert faulty["noise"] == {"stages": SPELLED, "bound_m": 4 * 0.02}
    for one, other in zip(Dataset(made).split("train"), Dataset(noisy).split("train"), strict=True):
        for name in ("occupancy", "tudf", "position", "quaternion", "origin", "world", "viewpoint"):
            assert_array_equal(getattr(one, name), getattr(other, name))
        both = np.isfinite(one.ranges) & np.isfinite(other.ranges)
        assert (np.isfinite(other.ranges) <= np.isfinite(one.ranges)).all()
        off = np.abs(one.ranges[both] - other.ranges[both])
        assert 0 < off.max() <= 0.08 + 1e-6


@pytest.mark.parametrize("noise", ["", CHAIN])
def test_scanned_again_it_is_to_the_bit_what_would_have_been_drawn(made, noisy, tmp_path, noise):
    chain = Noise.parse(noise) if noise else None
    plan = plan_rescan(Dataset(made), tmp_path / "again", chain=chain)
    build(plan, shard_range=(0, 3))
    (tmp_path / "again" / "train-00001.h5").unlink()
    assert not Dataset(plan.folder, partial=True).manifest.complete
    summary = build(plan)
    assert summary.digest == Dataset(noisy if noise else made).manifest.digest
    assert Dataset(plan.folder).manifest.rescan == {"digest": Dataset(made).manifest.digest}
    assert not failed(plan.folder)


def test_another_sensor_sees_the_same_worlds_from_the_same_poses(made, tmp_path):
    rays = BeamTable.of(Lidar(rows=5, columns=40))
    plan = plan_rescan(
        Dataset(made), tmp_path / "again", lidar=rays, chain=Noise.parse("quantise:0.1")
    )
    build(plan)
    one, other = Dataset(made).split("test")[2], Dataset(plan.folder).split("test")[2]
    assert other.ranges.shape == (5, 40)
    assert_array_equal(one.occupancy, other.occupancy)
    assert_array_equal(one.quaternion, other.quaternion)
    assert not failed(plan.folder)
    with pytest.raises(DatasetError, match="is the dataset itself"):
        plan_rescan(Dataset(made), made)


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(("name", "noise"), [("raster", ""), ("table", "quantise:0.1")])
def test_what_was_scanned_again_is_published_with_the_command_that_does_so(
    made, tmp_path, name, noise
):
    sensor = Lidar(rows=5, columns=40)
    lidar, chain = (
        sensor if name == "raster" else BeamTable.of(sensor),
        Noise.parse(noise) if noise else None,
    )
    mapping = {"scans": 2, "scan_spacing_m": 0.3, "fusion": "log-odds"} if noise else {}
    build(plan_rescan(Dataset(made), tmp_path / "again", lidar=lidar, chain=chain, mapping=mapping))
    out = tmp_path / "out"
    request = Request(dataset=tmp_path / "again", repository="ada/again", out=out)
    stage(request, (("files", "all there"),))
    found = Dataset(out)
    card = (out / "README.md").read_text()
    assert f"{found.manifest.lidar}" in card
    assert (
        f"`ORIGINAL` stands for that dataset, whose digest is `{Dataset(made).manifest.digest}`."
        in card
    )
    assert not noise or "simulated noise, `quantise:step_m=0.1`" in card
    (line,) = (line for line in card.splitlines() if line.startswith("scenegen rescan ORIGINAL"))
    context = rescan.make_context("rescan", shlex.split(line)[2:])
    asked = context.params
    with context:
        given = mapping_given(asked)
    again = plan_rescan(
        Dataset(made),
        tmp_path / "third",
        lidar=named_lidar(str(out / asked["lidar"])),
        chain=named_noise(asked["noise"], found.lidar),
        engine=asked["engine"],
        mapping=given,
    )
    assert build(again).digest == found.manifest.digest
    edited(tmp_path / "again", kind="my_worlds:Fence")
    examine(request)  # a kind of somebody's own need not be named, since nothing is drawn
    edited(tmp_path / "again", generator=GENERATOR + 1)
    with pytest.raises(PublishError, match="would not make the same dataset again"):
        examine(request)


def edited(folder, **entries):
    found = json.loads((folder / NAME).read_text())
    (folder / NAME).write_text(json.dumps({**found, **entries}))
    return folder


def test_what_the_noise_cannot_have_done_is_found(noisy, tmp_path):
    def copy(name, **entries):
        import shutil

        return edited(Path(shutil.copytree(noisy, tmp_path / name)), **entries)

    assert "rays" in failed(
        copy("weaker", noise={"stages": SPELLED.replace("0.02", "0.01"), "bound_m": 0.04})
    )
    assert "laws" in failed(
        copy("far weaker", noise={"stages": "dropout:share=0.05", "bound_m": 0.0}), quick=True
    )
    assert "laws" in failed(copy("clean", noise=None, version=1), quick=True)
    told = failed(copy("other bound", noise={"stages": SPELLED, "bound_m": 0.5}))
    assert "noise.bound_m = 0.5: its stages have 0.08 with this sensor" in told["manifest"]


@pytest.mark.parametrize(
    ("entries", "told"),
    [
        ({"version": 1}, "version = 1: expected 1.2 with noise"),
        ({"noise": None}, "version = 1.2: expected 1 with nothing of a minor version"),
        ({"noise": {"stages": "range"}}, "noise.bound_m is missing"),
        (
            {"noise": {"stages": "range", "bound_m": -1.0}},
            "noise.bound_m = -1.0: expected metres, or null",
        ),
        ({"noise": {"stages": "a\nb", "bound_m": None}}, "noise.stages ="),
        ({"rescan": {"digest": "x"}}, "rescan.digest"),
        (
            {"labels": {"by": "name", "classes": ["nothing"]}},
            "labels: expected exactly where `fields` names those of labels",
        ),
    ],
)
def test_a_strangers_word_is_not_trusted(noisy, tmp_path, entries, told):
    (tmp_path / NAME).write_bytes((noisy / NAME).read_bytes())
    with pytest.raises(DatasetError) as caught:
        Dataset(edited(tmp_path, **entries))
    assert told in str(caught.value)


def test_no_reader_imports_a_stage_that_a_manifest_names(noisy, tmp_path, monkeypatch):
    import shutil

    (tmp_path / "trap.py").write_text("raise SystemExit('imported')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    stages = {"stages": "range,trap:Stage:3", "bound_m": 0.08}
    folder = edited(Path(shutil.copytree(noisy, tmp_path / "data")), noise=stages)
    Dataset(folder, partial=True)
    report = verify(folder)
    skipped = {check.name for check in report.checks if check.skipped}
    assert {"rays", "regenerated"} <= skipped
    with pytest.raises(PublishError, match="none of scenegen's own"):
        check_source(Dataset(folder), *source_file(Dataset(folder).manifest))
    recipe = Dataset(noisy).manifest.parameters["recipe"] | {"noise": {"stages": "trap:Stage"}}
    assert (
        "recipe.noise: is there"
        in failed(edited(Path(shutil.copytree(noisy, tmp_path / "in")), recipe=recipe))["manifest"]
    )
    again = edited(Path(shutil.copytree(noisy, tmp_path / "engine")), engine="trap:Engine")
    with pytest.raises(
        DatasetError, match="not imported because a manifest names it; give --engine"
    ):
        plan_rescan(Dataset(again), tmp_path / "out")
    assert "trap" not in sys.modules


@pytest.mark.parametrize("noise", ["divergence:3:returns=dual", "intensity"])
def test_what_ranges_cannot_hold_is_refused_before_anything_is_written(tmp_path, noise):
    with pytest.raises(GenerationError, match="a dataset holds one range a ray"):
        made_with(tmp_path / "data", noise)
    assert not (tmp_path / "data").exists()


def test_ranges_beyond_the_sensors_are_refused_before_anything_is_written(tmp_path, monkeypatch):
    (tmp_path / "far_noise.py").write_text(
        "from lidarsim.noise.losses import Dropout\n"
        "class Far(Dropout):\n"
        "    def apply(self, returns, view, *, rng): return returns.but(ranges=returns.ranges * "
        "3)\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(GenerationError, match="noise stage far_noise:Far gave"):
        made_with(tmp_path / "data", "far_noise:Far")
    assert not (tmp_path / "data").exists()


def test_corrected_motion_is_refused_and_motion_that_bends_walls_is_not():
    rays = BeamTable.of(Lidar(rows=4, columns=30)).rays.copy()
    rays[..., 3] = np.linspace(0.0, 0.1, 30)
    base = dataclasses.replace(small_recipe(), lidar=BeamTable(rays=rays))
    place = {"seed": 1, "split": "train", "unit": 0}
    bent = dataclasses.replace(base, noise=Noise.parse("motion:5"))
    clean, moved = (draw_unit(DrawnWorlds(it), it, **place).samples[0] for it in (base, bent))
    assert (clean.ranges != moved.ranges).mean() > 0.3
    told = dataclasses.replace(base, noise=Noise.parse("motion:5:corrected=true"))
    with pytest.raises(GenerationError, match="rays begin where the scan does"):
        draw_unit(DrawnWorlds(told), told, **place)  # type: ignore[arg-type]


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
    with pytest.raises(
        RecipeError, match=r"it\.toml: \[noise\] noise: unknown noise stage 'rnage'; did you mean"
    ):
        read_recipe(file)
    with pytest.raises(RecipeError, match="comes with none for 'datasheet'"):
        preset("pillar", noise="datasheet")
