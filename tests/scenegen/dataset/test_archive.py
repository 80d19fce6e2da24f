"""Archives of worlds are read by the numbers in their members' names, however many worlds there
are."""

import zipfile

import pytest

from scenegen.dataset.archive import open_archive
from tests.refusals import refuses


def members_of(path, name):
    """The members of an archive at `path` that has one, a world of this name."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(name, "<mujoco/>")
    with open(path, "rb") as file, open_archive(file, "a.zip") as members:
        return members.world(name)


@pytest.mark.parametrize("number", [0, 17, 999_999, 1_000_000, 199_999_999])
def test_a_world_is_found_by_its_number(tmp_path, number):
    assert members_of(tmp_path / "a.zip", f"{number:06d}.xml") == (b"<mujoco/>", {})


@pytest.mark.parametrize("name", "17 0000017 1234567890 00001a ٠٠٠٠١٧".split())
def test_a_number_is_written_in_one_way(tmp_path, name):
    refuses(name, members_of, tmp_path / "a.zip", f"{name}.xml")
