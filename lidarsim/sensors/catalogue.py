"""Sensors that people have, as `catalogue.toml` describes them: an object each, under the name that
`CATALOGUE` gives it, as in ``from lidarsim.sensors.catalogue import VLP_16``."""

import tomllib
from typing import TYPE_CHECKING, Any

from lidarsim.sensors import CATALOGUE, SENSORS, TEXT

if TYPE_CHECKING:  # else users' checkers know of no such name

    def __getattr__(name: str) -> Any: ...


TABLES = tomllib.loads(TEXT)

for name, attribute in CATALOGUE.items():
    fields = TABLES[name]
    globals()[attribute] = SENSORS.find(fields.pop("sensor"))(name=name, **fields)
