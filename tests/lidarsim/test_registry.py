"""Things by name: the toolkit's, and a user's own."""

import sys

import pytest

from lidarsim.registry import Registry
from tests.refusals import refuses
from tests.scenegen import cases

ENGINES = Registry(
    "engine", {"plain": "lidarsim.scan:cast"}, needs={"__call__": "so that it can be called"}
)


def test_a_users_own_is_found_where_the_user_stands(standing):
    (standing / "own_engines.py").write_text("def fast(): return 7")
    (standing / "shed").mkdir()
    (standing / "shed" / "engines.py").write_text("def slow(): return 8")
    assert ENGINES.find("own_engines:fast")() == 7
    assert ENGINES.find("shed.engines:slow")() == 8


def test_no_file_of_the_users_takes_the_place_of_a_librarys(standing):
    (standing / "own.py").write_text("import colorsys\ncalled = colorsys.rgb_to_hsv")
    (standing / "colorsys.py").write_text("rgb_to_hsv = 'not this one'")
    sys.modules.pop("colorsys", None)
    assert callable(ENGINES.find("own:called"))


@pytest.mark.parametrize("name", [*sum(cases("../lidarsim/registry"), ()), "lidar\n", 5])
def test_what_is_missing_is_told_in_one_line(standing, name):
    (standing / "own.py").write_text("here = 1\nclass Empty: pass")
    (standing / "broken.py").write_text("\n1 / 0")
    (standing / "needy.py").write_text("import not_installed_anywhere")
    refuses(name, ENGINES.find, name)


def test_a_field_without_a_default_counts_as_there(standing):
    (standing / "own.py").write_text(
        "from dataclasses import dataclass\n@dataclass\nclass Sensor:\n    shape: tuple\nclass "
        "Other: pass\nclass Slow:\n    shape = property(lambda self: 1 / 0)\nslow = Slow()"
    )
    sensors = Registry("sensor", {}, needs={"shape": "a tuple of counts"})
    assert sensors.find("own:Sensor")
    assert sensors.find("own:slow")  # without being asked for its shape
    refuses("own:Other", sensors.find, "own:Other")
