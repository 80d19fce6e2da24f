"""`generate --like`: a dataset again by its manifest, and pairs of the same worlds and poses."""

import dataclasses
import shutil

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from lidarsim import BeamTable, Lidar
from lidarsim.noise.chain import Noise
from scenegen import GENERATOR
from scenegen.base.errors import DatasetError
from scenegen.dataset.build import build, plan_dataset
from scenegen.dataset.like import plan_like
from scenegen.dataset.read import Dataset
from scenegen.dataset.schema import NAME
from scenegen.draw.parts.normals import Normals
from scenegen.draw.source import read_scenes
from scenegen.verification import verify
from scenegen.worlds.labels import labels_by
from tests.command_line import done
from tests.conftest import COUNTS, contents, dataset_in, scene_recipe, small_recipe
from tests.refusals import refuses, refuses_command
from tests.scenegen.conftest import built
from tests.scenegen.dataset import OF_POSES, SCENE
from tests.scenegen.dataset.conftest import NOISE, SEVERAL
from tests.scenegen.verification import forge


def digest_like(dataset, folder, **changes):
    """The digest of a dataset like another, but for the changes."""
    return build(plan_like(dataset, folder, **changes)).digest


def test_the_manifest_alone_draws_the_same_bytes(noisy, tmp_path):
    shutil.copy(noisy.folder / NAME, tmp_path)
    build(plan_like(tmp_path / NAME, tmp_path / "d"), workers=2)
    assert contents(tmp_path / "d") == contents(noisy.folder)


def test_with_other_counts_it_is_the_dataset_of_that_size(made, tmp_path):
    counts = {"train": 4, "val": 1, "test": 0}
    fresh = dataset_in(tmp_path / "fresh", seed=3, counts=counts, shard_samples=3)
    assert digest_like(made, tmp_path / "like", counts=counts) == fresh.digest


def test_worlds_from_files_give_the_same_samples(tmp_path):
    (tmp_path / "scenes").mkdir()
    for n in range(2):
        (tmp_path / "scenes" / f"{n}.xml").write_text(SCENE.format(x=4 + n))
    options = {"counts": {"train": 9, "val": 3, "test": 0}, "seed": 0}
    source = read_scenes(tmp_path / "scenes", **options)
    plan = plan_dataset(tmp_path / "d", scene_recipe(), source, **options, shard_samples=3)
    scenes, again = built(plan), built(plan_like(tmp_path / "d", tmp_path / "again"))
    assert again.digest == scenes.digest
    assert again.manifest.like == scenes.digest
    assert again.manifest.scenes == scenes.manifest.scenes
    assert verify(again.folder).ok


def test_another_sensor_scans_from_the_same_poses(noisy, tmp_path):
    lidar = BeamTable.of(Lidar(rows=5, columns=40))
    pair = built(plan_like(noisy.folder, tmp_path / "d", lidar=lidar))
    assert pair.lidar == lidar
    assert pair.manifest.like == noisy.digest
    for original, sample in zip(noisy.split("train"), pair.split("train"), strict=True):
        for name in OF_POSES:
            assert_array_equal(getattr(original, name), getattr(sample, name))
        assert sample.ranges.shape == (5, 40)
    assert verify(pair.folder).ok


@pytest.mark.parametrize("noise", ["", NOISE])
def test_other_noise_gives_what_would_have_been_drawn_with_it(made, noisy, tmp_path, noise):
    original, expected = (made, noisy) if noise else (noisy.folder, Dataset(made))
    chain = Noise.parse(noise) if noise else Noise()
    assert digest_like(original, tmp_path / "d", noise=chain) == expected.digest


def test_fewer_scans_are_those_that_would_have_been_drawn(made, several, tmp_path):
    digest = digest_like(several.folder, tmp_path / "d", mapping={"scans": 1})
    assert digest == Dataset(made).digest


def test_of_more_scans_the_flight_is_flown_again(made, several, tmp_path):
    assert digest_like(made, tmp_path / "d", mapping=SEVERAL) == several.digest


def test_a_flight_that_comes_out_otherwise_is_refused(made, tmp_path):
    moved = forge.copy(made, tmp_path / "moved")
    forge.edit(moved, "train-00000.h5", lambda arrays: np.add.at(arrays["position"], 1, 1e-9))
    refuses("two scans", lambda: build(plan_like(moved, tmp_path / "no", mapping={"scans": 2})))
    assert not (tmp_path / "no").exists()


def test_parts_are_those_of_the_original(tmp_path):
    parts = {"labels": labels_by("class", ()), "normals": Normals()}
    original = dataset_in(tmp_path / "d", dataclasses.replace(small_recipe(), parts=parts))
    build(plan_like(tmp_path / "d", tmp_path / "noisy", noise=Noise.parse("range")))
    again = built(plan_like(tmp_path / "noisy", tmp_path / "clean", noise=Noise()))
    assert again.digest == original.digest
    assert again.manifest.parts == original.manifest.parts


@pytest.mark.parametrize(("path", "value"), [("generator", GENERATOR + 1), ("recipe.version", 7)])
def test_what_would_come_out_otherwise_here_is_refused(made, tmp_path, path, value):
    shutil.copy(made / NAME, tmp_path)
    forge.edit_at(tmp_path, path, str(value))
    refuses(path, plan_like, tmp_path / NAME, tmp_path / "d")


MINE = """from dataclasses import dataclass
from scenegen.worlds.kinds.pillar import Pillar
@dataclass(frozen=True, kw_only=True)
class Mine(Pillar):
    version = 3
"""


def test_a_users_own_kind_is_imported_where_the_user_names_it(standing, monkeypatch):
    (standing / "mine.py").write_text(MINE)
    monkeypatch.syspath_prepend(str(standing))
    original = dataset_in(standing / "d", small_recipe("mine:Mine"))
    (standing / "mine.py").write_text("raise SystemExit('imported')")
    assert digest_like(standing / "d", standing / "scanned") == original.digest
    (standing / "mine.py").write_text(MINE)
    drawn = built(plan_like(standing / "d" / NAME, standing / "drawn", kind="mine:Mine"))
    assert drawn.digest == original.digest
    assert drawn.manifest.like is None


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("engine", '"trap:Engine"'),
        ("recipe.noise", '{"stages": "range,trap:Stage:3", "bound_m": 0.08, "version": 2}'),
        ("recipe.kind", '"trap:Kind"'),
    ],
)
def test_nothing_that_a_manifest_names_is_imported(noisy, trap, path, value):
    shutil.copy(noisy.folder / NAME, trap)
    forge.edit_at(trap, path, value)
    with pytest.raises(DatasetError):
        plan_like(trap / NAME, trap / "d")


def test_what_a_dataset_cannot_be_made_into_is_refused(made, tmp_path):
    noise, sensor = {"noise": Noise.parse("range")}, {"lidar": Lidar(rows=4)}
    refuses("another kind", plan_like, made, tmp_path, kind="maze")
    refuses("noise without poses", plan_like, made / NAME, tmp_path, **noise)
    refuses("sensor without poses", plan_like, made / NAME, tmp_path, **sensor)
    refuses("counts of a second scan", plan_like, made, tmp_path, **sensor, counts=COUNTS)
    refuses("over itself", plan_like, made, made)


@pytest.mark.parametrize("case", ["moved", "moved and signed", "other worlds"])
def test_nothing_is_made_of_samples_that_are_not_what_their_dataset_says(made, tmp_path, case):
    folder = forge.copy(made, tmp_path / "bad")
    if case == "other worlds":
        more = {"000009.xml": b"<mujoco/>"}
        forge.rezip(folder / "train-00000.worlds.zip", lambda members: members.update(more))
    else:
        arrays, attributes = forge.load(folder, "train-00000.h5")
        arrays["position"] += 0.05
        forge.store(folder, "train-00000.h5", arrays, attributes, digests=False)
    if case == "moved":
        shutil.copy(made / NAME, folder)
    refuses(case, lambda: build(plan_like(folder, tmp_path / "d", noise=Noise.parse("range"))))


def test_the_command_line_takes_it(noisy, tmp_path, capsys):
    like = f"generate --like {noisy.folder} --workers 1 --quiet"
    done(capsys, f"{like} -o {tmp_path}/clean --noise none --fusion log-odds")
    clean = Dataset(tmp_path / "clean").manifest
    assert clean.noise is None
    assert clean.mapping.fusion == "log-odds"
    assert clean.like == noisy.digest


OPTIONS = "--noise=datasheet --seed=3 --difficulty=hard --scene=a.xml --normals"


@pytest.mark.parametrize("option", OPTIONS.split())
def test_the_command_line_refuses_what_the_manifest_says(standing, made, capsys, option):
    (standing / "original").symlink_to(made)
    refuses_command(capsys, f"generate --like original -o d {option}")
    assert not (standing / "d").exists()
