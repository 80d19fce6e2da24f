"""Laws of datasets of many shards: those beyond the first thousand of a split lie in folders, and
nothing else changes. Here, ten take the place of a thousand."""

import pytest

from scenegen import load
from scenegen.base.files import list_dir
from scenegen.base.stores import Store
from scenegen.dataset import schema
from scenegen.dataset.build import build
from scenegen.verification import verify
from tests.conftest import plan_of
from tests.scenegen.verification.forge import edit_manifest, read

DEEP = "train-0001x/train-00010.h5"


@pytest.fixture(autouse=True)
def ten(drawn_once, monkeypatch):
    monkeypatch.setattr(schema, "INDEX_DIGITS", 1)


def plan(folder, train=36, seed=5):
    counts = {"train": train, "val": 3, "test": 3}
    return plan_of(folder, seed=seed, counts=counts, shard_samples=3)


@pytest.fixture(scope="module")
def digest(tmp_path_factory):
    """Of the same dataset without such folders."""
    return build(plan(tmp_path_factory.mktemp("flat") / "d")).digest


def test_a_dataset_in_folders_is_the_same_and_is_gone_on_with(tmp_path, digest):
    """Begun smaller, and made larger."""
    deep = tmp_path / "deep"
    for count in (31, 36):
        build(plan(deep, train=count))
    assert set(list_dir(deep)) >= {DEEP, "train-0001x/train-00011.worlds.zip", "train-00009.h5"}
    assert read(deep)["digest"] == digest
    (deep / DEEP).unlink()
    edit_manifest(deep, shards=[], complete=False)
    again = build(plan(deep))
    assert again.samples_written == 3
    assert again.digest == digest
    assert verify(deep).ok
    (deep / "train-0001x/train-00019.h5").touch()
    assert not verify(deep, quick=True).ok
    build(plan(deep, train=3, seed=6), force=True)
    assert "train-0001x/train-00010.worlds.zip" not in list_dir(deep)


def test_a_store_holds_the_same_folders(store, digest):
    for _ in range(2):
        assert build(plan(Store("s3://lab/deep"))).digest == digest
        assert (store / "lab" / "deep" / DEEP).is_file()
    assert load("s3://lab/deep")[31].world == 10
    assert verify("s3://lab/deep").ok


@pytest.mark.parametrize(
    ("index", "stem"),
    [(999, "val-00999"), (1000, "val-01xxx/val-01000"), (123456, "val-123xxx/val-123456")],
)
def test_a_shards_name_follows_from_its_number(monkeypatch, index, stem):
    monkeypatch.undo()
    assert schema.stem_of("val", index) == stem
    assert schema.SHARD_FILE.fullmatch(f"{stem}.worlds.zip")
    for folder in ("..", "train-99xxx", "val-01xxx/.."):
        assert not schema.SHARD_FILE.fullmatch(f"{folder}/{stem}.h5")
