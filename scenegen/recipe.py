"""Recipes: every number that decides what a dataset holds, resolved, checked, and read from TOML."""

import dataclasses
import difflib
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pydantic

from lidarsim import GridSpec, Lidar
from scenegen.errors import RecipeError
from scenegen.flight import Flight
from scenegen.recipes import find_kind, kind_names
from scenegen.recipes.kind import WorldKind


@dataclass(frozen=True, kw_only=True)
class Acceptance:
    """Which worlds and viewpoints are worth keeping: the paper removes "scenes with insufficient geometric complexity".

    Maps that are poorly seen stay: they are the task.
    """

    min_solids: float = 1.0
    """A world is rejected when, averaged along its flight, fewer solids than this reach into the map."""
    min_occupied_share: float = 0.0005
    """A viewpoint is rejected when a smaller share of its map's voxels than this is occupied."""
    min_returned_share: float = 0.01
    """A viewpoint is rejected when a smaller share of its rays than this returns."""
    max_draws: int = 50
    """Draws of one world after which generation gives up."""

    def __post_init__(self) -> None:
        if not self.min_solids >= 0:
            raise ValueError(f"min_solids = {self.min_solids}: expected at least 0")
        for name in ("min_occupied_share", "min_returned_share"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} = {getattr(self, name)}: expected a share from 0 to 1")
        if self.max_draws < 1:
            raise ValueError(f"max_draws = {self.max_draws}: expected at least 1")


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Everything besides the seed and the counts that decides a dataset's content.

    Raises ValueError where flights have no room in the world.
    """

    kind: str
    """Name of a kind of world, or ``scene`` for worlds drawn by hand."""
    world: WorldKind | None = None
    """How worlds are drawn; None for worlds drawn by hand."""
    flight: Flight = field(default_factory=Flight)
    accept: Acceptance = field(default_factory=Acceptance)
    lidar: Lidar = field(default_factory=Lidar)
    grid: GridSpec = field(default_factory=GridSpec)

    def __post_init__(self) -> None:
        if self.world is not None:
            self.flight.bounds(self.world.size_m)

    @property
    def version(self) -> int:
        """Of the kind's preset; 0 for worlds drawn by hand."""
        return 0 if self.world is None else self.world.version

    def resolved(self) -> dict[str, Any]:
        """The manifest's `recipe`: every parameter but the sensor's and the grid's, as plain JSON values."""
        tables = {"world": self.world, "flight": self.flight, "accept": self.accept}
        resolved: dict[str, Any] = {"version": self.version}
        resolved |= {name: dataclasses.asdict(table) for name, table in tables.items() if table is not None}
        return resolved


def preset(kind: str) -> Recipe:
    """The recipe of a kind as it comes. Raises RecipeError for an unknown kind, suggesting the nearest."""
    return make_recipe(kind, {}, where="preset")


def read_recipe(path: Path, kind: str | None = None) -> Recipe:
    """A recipe from a TOML file: `kind`, and tables [world], [flight], [accept], [lidar] and [grid] of what differs
    from the preset. `kind`, where given, stands in for the file's.

    Raises RecipeError naming the file, the table and the parameter.
    """
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise RecipeError(f"{path}: cannot be read: {error}") from None
    except tomllib.TOMLDecodeError as error:
        raise RecipeError(f"{path}: not valid TOML: {error}") from None
    named = tables.pop("kind", None)
    if kind is None and named is None:
        raise RecipeError(f'{path}: names no kind; add a line such as kind = "pillar", or give --kind')
    if kind is not None and named is not None and kind != named:
        raise RecipeError(f"{path}: is a recipe for kind {named!r}, not for {kind!r}; leave one of the two out")
    return make_recipe(kind or str(named), tables, where=str(path))


def make_recipe(kind: str, tables: dict[str, Any], *, where: str) -> Recipe:
    """The preset of `kind` with the values in `tables` put in; `where` names their source in errors."""
    parts: dict[str, type] = {"flight": Flight, "accept": Acceptance, "lidar": Lidar, "grid": GridSpec}
    defaults: dict[str, dict[str, Any]] = {}
    if kind != "scene":
        _check_name(kind, kind_names(), "kind", where)
        parts["world"] = found = find_kind(kind)
        defaults = {"flight": dict(found.flight_defaults), "accept": dict(found.accept_defaults)}
    for name, table in tables.items():
        _check_name(name, tuple(sorted(parts)), "table", where)
        if not isinstance(table, dict):
            raise RecipeError(f"{where}: {name} = {table!r}: expected a table, [{name}], of parameters")
    built = {
        name: _from_table(part, defaults.get(name, {}) | dict(tables.get(name, {})), f"{where}: [{name}]")
        for name, part in parts.items()
    }
    try:
        return Recipe(kind=kind, **built)
    except ValueError as error:
        raise RecipeError(f"{where}: [flight] {error}") from None


def _from_table(part: type, table: dict[str, Any], where: str) -> Any:
    """An instance of the dataclass `part` from a table of values, types and bounds checked."""
    names = tuple(item.name for item in dataclasses.fields(part))
    for name in table:
        _check_name(name, names, "parameter", where)
    for name, value in table.items():
        default = getattr(part, name, value)  # a kind may have parameters without a default
        if isinstance(value, bool | str) and type(value) is not type(default):
            raise RecipeError(f"{where} {name} = {value!r}: expected something like {default!r}")
    try:
        return pydantic.TypeAdapter(_finite(part)).validate_python(table)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        at = ".".join(str(step) for step in first["loc"])
        reason = first["msg"].removeprefix("Value error, ")
        named = f"{at} = {first['input']!r}: " if at else ""
        raise RecipeError(f"{where} {named}{reason}") from None


def _finite(part: type) -> type:
    """`part`, to be checked for numbers that are none."""
    part.__pydantic_config__ = pydantic.ConfigDict(allow_inf_nan=False)  # type: ignore[attr-defined]
    return part


def _check_name(name: str, known: tuple[str, ...], what: str, where: str) -> None:
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known)}"
        raise RecipeError(f"{where}: unknown {what} {name!r}; {hint}")
