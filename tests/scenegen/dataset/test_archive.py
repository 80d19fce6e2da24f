"""Archives of worlds are read by the numbers in their members' names, however many worlds there
are."""

import zipfile

import pytest

from scenegen.base.errors import CorruptFileError
from scenegen.dataset.archive import open_archive
from scenegen.dataset.shard import zip_reproducibly


@pytest.mark.parametrize("number", [0, 17, 999_999, 1_000_000, 199_999_999])
def test_a_world_is_found_by_its_number(tmp_path, number):
    path = tmp_path / "a.zip"
    path.write_bytes(zip_reproducibly(((f"{number:06d}.xml", b"<mujoco/>"),)))
    with open(path, "rb") as file, open_archive(file, "a.zip") as members:
        assert members.world(f"{number:06d}.xml") == (b"<mujoco/>", {})


@pytest.mark.parametrize(
    "name", ["17.xml", "0000017.xml", "1234567890.xml", "00001a.xml", "٠٠٠٠١٧.xml"]
)
def test_a_number_is_written_in_one_way(tmp_path, name):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr(name, "<mujoco/>")
    with (
        open(tmp_path / "a.zip", "rb") as file,
        pytest.raises(CorruptFileError, match="expected a"),
        open_archive(file, "a.zip"),
    ):
        pass
