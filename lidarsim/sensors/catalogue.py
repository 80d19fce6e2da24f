"""Sensors that people have, from `catalogue.toml`: an object each, under its name in `CATALOGUE`,
as in ``from lidarsim.sensors.catalogue import VLP_16``."""

import tomllib
from typing import TYPE_CHECKING, Any

from lidarsim.sensors import CATALOGUE, SENSORS, TEXT

if TYPE_CHECKING:  # users' type checkers cannot see names that are set at run time

    def __getattr__(name: str) -> Any: ...


TABLES = tomllib.loads(TEXT)

for name, attribute in CATALOGUE.items():
    fields = TABLES[name]
    globals()[attribute] = SENSORS.find(fields.pop("sensor"))(name=name, **fields)
