"""`generate --like`: a dataset again by its manifest, and pairs of the same worlds and poses."""

import dataclasses
import shutil

import numpy as np
import pytest

from lidarsim import BeamTable, Lidar
from lidarsim.noise.chain import Noise
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
from tests.scenegen import each_case
from tests.scenegen.conftest import built
from tests.scenegen.dataset import SCENE, of_poses
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
    (scenes := tmp_path / "scenes").mkdir()
    for n in range(2):
        (scenes / f"{n}.xml").write_text(SCENE.format(x=4 + n))
    options = {"counts": {"train": 9, "val": 3, "test": 0}, "seed": 0}
    source = read_scenes(scenes, **options)
    plan = plan_dataset(tmp_path / "d", scene_recipe(), source, **options, shard_samples=3)
    first, again = built(plan), built(plan_like(tmp_path / "d", tmp_path / "again"))
    assert again.digest == again.manifest.like == first.digest
    assert again.manifest.scenes == first.manifest.scenes
    assert verify(again.folder).ok


def test_another_sensor_scans_from_the_same_poses(noisy, tmp_path):
    lidar = BeamTable.of(Lidar(rows=5, columns=40))
    pair = built(plan_like(noisy.folder, tmp_path / "d", lidar=lidar))
    assert (pair.lidar, pair.manifest.like) == (lidar, noisy.digest)
    samples = pair.split("train")
    assert of_poses(samples) == of_poses(noisy.split("train"))
    assert {sample.ranges.shape for sample in samples} == {(5, 40)}
    assert verify(pair.folder).ok


@pytest.mark.parametrize(
    ("original", "changes", "expected"),
    [
        ("noisy", {"noise": Noise()}, "made"),
        ("made", {"noise": Noise.parse(NOISE)}, "noisy"),
        ("several", {"mapping": {"scans": 1}}, "made"),
        ("made", {"mapping": SEVERAL}, "several"),  # whose flights are flown again
    ],
)
def test_a_second_scan_is_what_would_have_been_drawn(
    original, changes, expected, request, tmp_path
):
    folder, drawn = (
        request.getfixturevalue("made") if name == "made" else request.getfixturevalue(name).folder
        for name in (original, expected)
    )
    assert digest_like(folder, tmp_path / "d", **changes) == Dataset(drawn).digest


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
    assert (again.digest, again.manifest.parts) == (original.digest, original.manifest.parts)


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


@each_case("dataset/like", "path value")
def test_what_would_come_out_otherwise_or_is_a_strangers_is_refused(noisy, trap, path, value):
    """Nothing that a manifest names is imported."""
    shutil.copy(noisy.folder / NAME, trap)
    forge.edit_at(trap, path, value)
    refuses(path, plan_like, trap / NAME, trap / "d")


def test_what_a_dataset_cannot_be_made_into_is_refused(made, tmp_path):
    noise, sensor = {"noise": Noise.parse("range")}, {"lidar": Lidar(rows=4)}
    refuses("another kind", plan_like, made, tmp_path, kind="maze")
    refuses("noise without poses", plan_like, made / NAME, tmp_path, **noise)
    refuses("sensor without poses", plan_like, made / NAME, tmp_path, **sensor)
    refuses("counts of a second scan", plan_like, made, tmp_path, **sensor, counts=COUNTS)
    refuses("over itself", plan_like, made, made)


@pytest.mark.parametrize("case", ["moved", "moved and signed", "other worlds"])
def test_nothing_is_made_of_samples_that_are_not_what_their_dataset_says(made, tmp_path, case):
    folder, shard = forge.copy(made, tmp_path / "bad"), "train-00000.h5"
    arrays, attributes = forge.load(folder, shard)
    arrays["position"] += 0.05
    if case == "other worlds":
        more = {"000009.xml": b"<mujoco/>"}
        forge.rezip(folder / "train-00000.worlds.zip", lambda members: members.update(more))
    else:
        forge.store(folder, shard, arrays, attributes, digests=False)
    if case == "moved":
        shutil.copy(made / NAME, folder)
    refuses(case, lambda: build(plan_like(folder, tmp_path / "d", noise=Noise.parse("range"))))


def test_the_command_line_takes_it(noisy, tmp_path, capsys):
    like = f"generate --like {noisy.folder} --workers 1 --quiet"
    done(capsys, f"{like} -o {tmp_path}/clean --noise none --fusion log-odds")
    clean = Dataset(tmp_path / "clean").manifest
    assert (clean.noise, clean.mapping.fusion, clean.like) == (None, "log-odds", noisy.digest)


OPTIONS = "--noise=datasheet --seed=3 --difficulty=hard --scene=a.xml --normals"


@pytest.mark.parametrize("option", OPTIONS.split())
def test_the_command_line_refuses_what_the_manifest_says(standing, made, capsys, option):
    (standing / "original").symlink_to(made)
    refuses_command(capsys, f"generate --like original -o d {option}")
    assert not (standing / "d").exists()
