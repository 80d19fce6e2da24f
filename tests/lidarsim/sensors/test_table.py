"""Tables of rays: what they take, what they give back, and what they refuse."""

import dataclasses
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from lidarsim import BeamTable, Lidar
from lidarsim.sensors import SENSORS
from lidarsim.sensors.table import read_npy
from tests.refusals import refuses


@dataclasses.dataclass(frozen=True, kw_only=True)
class Fan:
    """A user's sensor: rays in the horizontal plane, one after the other."""

    rays: int = 9
    name: str = "a\nb"
    where: Path = Path("/home/ada/fan.txt")
    max_range_m: float = 5.0

    @property
    def shape(self):
        return (self.rays,)

    @cached_property
    def directions_body(self):
        angle = np.linspace(-1, 1, self.rays)
        return np.stack([np.cos(angle), np.sin(angle), np.zeros(self.rays)], axis=-1)

    @property
    def times_s(self):
        return np.arange(self.rays) / 100


@pytest.mark.parametrize("sensor", [Fan(), Lidar()])
def test_a_table_has_a_sensors_rays_to_the_bit(sensor):
    table = BeamTable.of(sensor)
    assert table.shape == sensor.shape
    assert table.max_range_m == sensor.max_range_m
    assert table.directions_body.tobytes() == np.ascontiguousarray(sensor.directions_body).tobytes()
    assert_array_equal(table.times_s, sensor.times_s)
    assert BeamTable.of(table) == table
    assert_array_equal(read_npy(table.npy), table.rays)


def test_a_table_says_what_made_it_and_names_no_folder():
    said = BeamTable.of(Fan()).made_by
    assert said.startswith("tests.lidarsim.sensors.test_table:Fan(rays=9, name=")
    assert "where=fan.txt" in said
    assert said.isprintable()


def test_a_table_cannot_be_changed():
    rays = np.tile([1.0, 0.0, 0.0, 0.0], (3, 1))
    table = BeamTable(rays=rays)
    rays[0, 0] = 7.0
    assert table.rays[0, 0] == 1.0
    with pytest.raises(ValueError):
        table.rays[0, 0] = 2.0


def test_a_file_is_a_sensor_by_name(tmp_path):
    table = BeamTable.of(Fan())
    (tmp_path / "fan.npy").write_bytes(table.npy)
    path, reach_m = f"{tmp_path}/fan.npy", np.float32(5)
    assert SENSORS.find("table")(rays=path, max_range_m=reach_m, sha256=table.sha256) == table
    for wrong in ({"rays": tmp_path / "fun.npy"}, {"sha256": "0" * 64}, {"made_by": "a\n"}):
        refuses([*wrong], BeamTable, **{"rays": path} | wrong)


@pytest.mark.parametrize("axes", [0, 5])
def test_shapes_have_one_to_four_axes(axes):
    refuses(axes, BeamTable, rays=np.broadcast_to([1.0, 0.0, 0.0, 0.0], (1,) * axes + (4,)))
