"""The published folder: still the dataset, readable by everyone, whole or absent, and true to what
it says."""

import hashlib
import json
import re
from dataclasses import replace

import h5py
import numpy as np
import pytest

from scenegen.dataset.read import Dataset
from scenegen.publish import stage as folder_module
from scenegen.publish.stage import Request, examine, stage
from scenegen.view.inspect import inspect
from tests.command_line import python
from tests.conftest import COUNTS, contents, dataset_in, small_recipe
from tests.refusals import refuses
from tests.scenegen import each_case
from tests.scenegen.conftest import names
from tests.scenegen.verification.forge import edit_at

CHECKS = (("files", "14 files hold"),)


@pytest.fixture(scope="module")
def out(made, tmp_path_factory):
    """A published folder; not to be changed."""
    out = tmp_path_factory.mktemp("publish") / "small-pillars"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(folder_module, "SHOWN", 2)
        stage(Request(dataset=made, repository="ada/small-pillars", out=out), CHECKS)
    return out


def digests(files):
    return {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}


def section(card, language, title):
    """Code blocks of a language under a heading."""
    body = card.partition(f"## {title}\n")[2].partition("\n## ")[0]
    return re.findall(rf"```{language}\n(.*?)```", body, flags=re.DOTALL)


def test_it_is_still_the_dataset_and_every_file_is_listed_with_its_digest(out, made):
    files = contents(out)
    assert files.items() >= contents(made).items()
    listed = [line.split("  ") for line in files.pop("SHA256SUMS").decode().splitlines()]
    assert {name: digest for digest, name in listed} == digests(files)
    assert not [path for path in out.rglob("*") if path.is_symlink()]


def test_the_cards_own_lines_read_it_with_plain_h5py(out):
    lines = section((out / "README.md").read_text(), "python", "Load it")[0]
    assert "scenegen" not in lines
    with h5py.File(out / "train-00000.h5") as shard:
        seen, solid = shard["observed"][0].sum(), shard["occupancy"][0].sum()
    printed = python("-c", lines, cwd=out.parent).stdout
    assert printed == f"{seen} of {solid} occupied voxels were observed\n"


def test_datasets_reads_it_offline_by_its_splits(out, tmp_path, monkeypatch):
    import datasets

    monkeypatch.setattr(datasets.config, "HF_HUB_OFFLINE", True)
    splits = datasets.load_dataset(str(out), cache_dir=str(tmp_path)).with_format("numpy")
    assert {name: len(split) for name, split in splits.items()} == COUNTS
    mine, theirs = Dataset(out).split("test")[-1], splits["test"][COUNTS["test"] - 1]
    for name in ("observed", "occupancy", "tudf", "ranges", "position", "world"):
        value = np.asarray(getattr(mine, name))  # numpy's format has float32
        assert np.array_equal(theirs[name], value.astype(theirs[name].dtype)), name


def croissant_issues(out):
    """What Croissant's own library has against the description."""
    import mlcroissant

    issues = mlcroissant.Dataset(str(out / "croissant.json")).metadata.ctx.issues
    return issues.errors | issues.warnings


def test_croissant_is_valid_and_describes_what_is_there(out, made):
    assert not croissant_issues(out)
    plain = json.loads((out / "croissant.json").read_text())
    assert plain["conformsTo"][0] == "http://mlcommons.org/croissant/1.1"
    about = "dataCollection dataBiases dataLimitations dataUseCases personalSensitiveInformation"
    assert all(plain[f"rai:{name}"] for name in about.split())
    files = {item["@id"]: item["sha256"] for item in plain["distribution"] if "sha256" in item}
    assert files.items() >= digests(contents(made)).items()
    records = plain["recordSet"][2]
    assert records["key"] == [{"@id": "test/sha256"}]
    described = {
        field["name"]: (field["dataType"].lower(), field.get("arrayShape", ""))
        for field in records["field"]
    }
    with h5py.File(out / "test-00000.h5") as shard:
        for name, stored in shard.items():
            kind, shape = described.pop(name)
            assert shape == ",".join(map(str, stored.shape[1:]))
            assert kind.partition(":")[2].replace("boolean", "bool") == stored.dtype.name
    assert described == {}


def test_the_card_says_what_the_files_hold(out, made):
    card = (out / "README.md").read_text()
    front = card.split("---\n")[1]
    assert "license: cc-by-4.0" in front
    assert '  - split: val\n    path: ["val-*.h5"]' in front
    statistics = inspect(Dataset(made))["splits"]["train"]["statistics"]["occupied"]
    mean, std = (100 * statistics[name] for name in ("mean", "std"))
    assert f"| voxels occupied, % | {mean:.2f} ± {std:.2f} |" in card
    assert Dataset(made).manifest.digest in card
    assert "- files: 14 files hold" in card
    with h5py.File(out / "train-00000.h5") as shard:
        for name in shard:
            assert f"| `{name}` | " in card
    for shown in re.findall(r"!\[.*?\]\((.*?)\)", card):
        assert (out / shown).read_bytes().startswith(b"\x89PNG")


def test_its_command_makes_the_same_dataset(out):
    """As test_like.py shows."""
    command = section((out / "README.md").read_text(), "", "Make it again")[0].split()
    assert command[2:] == ["--like", "dataset.json", "--out", "small-pillars"]


def test_the_lock_has_the_versions_that_made_it(out, made):
    software = dict(Dataset(made).manifest.software)
    head, _, *lines = (out / "requirements.lock.txt").read_text().splitlines()
    assert head.startswith(f"# scenegen {software.pop('scenegen')}, published with ")
    del software["machine"]
    assert dict(line.split("==") for line in lines) == software


@each_case("publish/stage", "path value")
def test_what_would_not_be_made_again_is_not_published(dataset, asked, path, value):
    edit_at(dataset, path, value)
    refuses(path, stage, asked, CHECKS)
    assert not asked.out.exists()


@pytest.mark.parametrize("named", [None, "a:C", "pillar"])
def test_a_kind_of_somebody_elses_has_to_be_named(asked, dataset, named):
    edit_at(dataset, "recipe.kind", '"a:B"')
    refuses(named, examine, replace(asked, kind=named))


def test_compact_datasets_and_absent_splits_publish_as_well(undrawn, tmp_path):
    recipe, made, out = small_recipe("geometric"), tmp_path / "made", tmp_path / "out"
    dataset_in(made, recipe, counts={"train": 4, "val": 0, "test": 1}, compact=True)
    stage(Request(dataset=made, repository="ada/g", out=out, licence="cc0-1.0"), CHECKS)
    card = (out / "README.md").read_text()
    assert "split: val" not in card
    assert "`free` and `tudf` follow from these" in card
    assert "license: cc0-1.0" in card
    assert not croissant_issues(out)
    assert Dataset(out).split("test")[0].tudf.shape == recipe.grid.shape


def test_the_same_request_gives_the_same_bytes_and_replaces_its_own_folder(asked):
    stage(asked, CHECKS)
    croissant = asked.out / "croissant.json"
    date = '"datePublished": "2001-02-03"'  # as if begun on another day
    croissant.write_text(re.sub('"datePublished": "[^"]*"', date, croissant.read_text()))
    stage(asked, CHECKS)
    first = contents(asked.out)
    stage(asked, CHECKS)
    assert contents(asked.out) == first
    assert date in croissant.read_text()
    assert names(asked.out.parent) == {asked.out.name}


def test_a_folder_of_somebody_elses_is_let_be(asked, dataset):
    stage(asked, CHECKS)
    (asked.out / "notes.md").write_text("mine")
    refuses("notes", stage, asked, CHECKS)
    for out in (dataset, dataset / "inside", dataset.parent):
        refuses(out.name, stage, replace(asked, out=out), CHECKS)
    assert Dataset(dataset).manifest.complete
    (asked.out / "notes.md").unlink()
    edit_at(asked.out, "seed", "7")
    refuses("another", stage, asked, CHECKS)


def test_a_damaged_shard_is_noticed_and_nothing_is_left(asked, dataset):
    shard = dataset / "val-00000.h5"
    content = bytearray(shard.read_bytes())
    content[len(content) // 2] ^= 1
    shard.write_bytes(content)
    refuses("damaged", stage, asked, CHECKS)
    assert list(asked.out.parent.iterdir()) == []


def test_too_many_files_and_a_collection_are_refused(asked, dataset, monkeypatch):
    refuses("collection", stage, replace(asked, dataset=dataset.parent), CHECKS)
    monkeypatch.setattr("scenegen.publish.stage.MAX_FILES", 13)
    refuses("13", stage, asked, CHECKS)


def test_where_links_are_not_possible_files_are_copied(asked, monkeypatch):
    def refuse(*args, **options):
        raise OSError(18, "Invalid cross-device link")

    linked, shard = stage(asked, CHECKS).files, asked.out / "train-00000.h5"
    assert shard.stat().st_nlink == 2
    monkeypatch.setattr(folder_module.os, "link", refuse)
    assert stage(asked, CHECKS).files == linked
    assert shard.stat().st_nlink == 1


@pytest.mark.parametrize(
    "name", ["pillar", "ada/../x", "/etc", "a/b/c", "ada/x y", "--repo", "ada/x.git"]
)
def test_a_repository_that_cannot_be_one_is_refused(name, tmp_path):
    refuses(name, Request, dataset=tmp_path, repository=name, out=tmp_path)
