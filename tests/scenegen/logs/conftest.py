"""A room, a sensor, and what recordings need."""

import pytest

from tests.command_line import beside

ROOM = beside(__file__, "room.xml")
"""No face of a solid lies where voxels meet."""
SENSOR = beside(__file__, "mine.toml")
RECORD = "scan room.xml --flight --sequence --length 6 --seed 3 --lidar mine.toml --noise intensity"


@pytest.fixture
def here(standing):
    """A folder with a room and a sensor."""
    (standing / "room.xml").write_text(ROOM)
    (standing / "mine.toml").write_text(SENSOR)
    return standing


@pytest.fixture
def ros():
    """Needed to write recordings, and to read them in another way."""
    pytest.importorskip("mcap_ros2", reason="mcap-ros2-support is not installed")
    return pytest.importorskip("rosbags", reason="rosbags is not installed")
