"""Options of commands: those that several share, and those that are fields of a configuration."""

import dataclasses
import math
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar

import rich_click as click
from click.core import ParameterSource

from lidarsim.parameters import BOUNDS, Bounds
from lidarsim.sensors import SENSORS
from scenegen import SPLITS
from scenegen.cli.types import (
    Choice,
    DatasetPath,
    Named,
    Number,
    Numbers,
    OutputFile,
    OutputFolder,
    Place,
)
from scenegen.errors import printable
from scenegen.limits import MOST_WORKERS
from scenegen.run import EXECUTORS, LOCAL
from scenegen.worlds.mapping import Mapper

Function = TypeVar("Function", bound=Callable[..., Any])


def _workers(ctx: Any, parameter: Any, given: int | None) -> int:
    from scenegen.run.workers import cores

    return given or cores()


dataset_argument = click.argument("dataset", type=DatasetPath())
datasets_argument = click.argument("datasets", nargs=-1, type=DatasetPath())
workers_option = click.option(
    "--workers",
    type=click.IntRange(1, MOST_WORKERS),
    callback=_workers,
    help="Processes.  [default: all cores]",
)
on_option = click.option(
    "--on",
    type=Place(EXECUTORS),
    default=LOCAL,
    show_default=True,
    metavar="PLACE",
    help=f"Where the work is done: {', '.join(EXECUTORS.known)}, or MODULE:CLASS, each with "
    f"://ADDRESS or without.",
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
quiet_option = click.option("--quiet", is_flag=True, help="Print errors alone.")
device_option = click.option(
    "--device", default="auto", show_default=True, help="Where to compute: cpu, cuda, cuda:1 …"
)
kind_option = click.option(
    "--kind",
    metavar="MODULE:CLASS",
    help="The dataset's own kind, where it is not one of scenegen's: its module is imported to "
    "draw worlds again.",
)


def split_option(default: str, help: str) -> Callable[[Function], Function]:
    """--split, one of a dataset's."""
    return click.option(
        "--split", type=click.Choice(SPLITS), default=default, show_default=True, help=help
    )


def seed_option(help: str) -> Callable[[Function], Function]:
    """--seed of what is drawn."""
    return click.option(
        "--seed", type=click.IntRange(min=0), default=0, show_default=True, help=help
    )


def out_option(
    help: str, default: Path | None = None, *, file: bool = False, places: bool = False
) -> Callable[[Function], Function]:
    """-o: the folder, with `places` also a place, or, with `file`, the file to write; the parameter
    is `out`."""
    kind = OutputFile() if file else OutputFolder(places=places)
    names = ("--output", "--out") if file else ("--out", "--output")
    return click.option(
        "-o", *names, "out", type=kind, default=default, show_default=True, help=help
    )


def lidar_option(what: str, default: str = "") -> Callable[[Function], Function]:
    """--lidar, or --sensor: a sensor's name, a TOML file of one, or module:Object; the parameter is
    `lidar`."""
    told = (
        f"{what}: a name (`scenegen sensors` lists them), a .toml file, or MODULE:CLASS.{default}"
    )
    return click.option(
        "--lidar", "--sensor", "lidar", type=Named(SENSORS, file=".toml"), help=told
    )


def _noise(ctx: Any, parameter: Any, given: str | None) -> str | None:
    """The text as it is, if each of its stages can be read; the chain is made once the sensor is
    known."""
    from lidarsim.noise.chain import DATASHEET, Noise

    try:
        for stage in [] if given is None else given.split(","):
            if stage.strip() != DATASHEET:
                Noise.parse(stage)
    except ValueError as error:
        raise click.BadParameter(printable(error)) from None
    return given


noise_option = click.option(
    "--noise",
    callback=_noise,
    metavar="STAGE:VALUE…,…",
    help="Faults of the sensor, such as range:0.02,dropout:0.05, or datasheet for what it comes "
    "with.  [default: none]",
)


def options_of(
    config: type, prefix: str = "", *, default: str | None = None, **helps: str
) -> Callable[[Function], Function]:
    """An option for each field of the dataclass `config` that `helps` names, with that text. Its
    default, type, choices and bounds are the field's; so is its name, after `prefix` and without a
    unit: `beta_m` becomes --beta. Several numbers are given with commas between. `default` is shown
    where an option that is not given has another effect than the field's default."""

    def add(function: Function) -> Function:
        for name, text in reversed(helps.items()):
            function = _option(config, name, text, prefix, default or True)(function)
        return function

    return add


def mapping_options(default: str | None = None) -> Callable[[Function], Function]:
    """Options of how maps are made, of commands that draw or scan again; for `default` see
    `options_of`."""
    helps = {
        "scans": "Scans that make a map: the sample's own, and those before it on the flight.",
        "scan_spacing_m": "Metres flown from scan to scan.",
        "fusion": "How they make one map.",
        "map_ahead_m": "Where the map's middle lies from the sensor: metres forward, to the left, "
        "and up.",
    }
    return options_of(Mapper, default=default, **helps)


def mapping_given(options: Mapping[str, Any]) -> dict[str, Any]:
    """Those of `options` that the user gave and that say how maps are made."""
    return {name: value for name, value in taken(Mapper, options).items() if was_given(name)}


def taken(config: type, options: Mapping[str, Any]) -> dict[str, Any]:
    """Those of `options` that are fields of the dataclass `config`."""
    return {
        item.name: options[item.name] for item in dataclasses.fields(config) if item.name in options
    }


def was_given(name: str) -> bool:
    """Whether the user gave the current command's parameter `name`, by whatever means."""
    context = click.get_current_context()
    return context is not None and context.get_parameter_source(name) is not ParameterSource.DEFAULT


def _option(
    config: type, name: str, text: str, prefix: str, shown: str | Literal[True]
) -> Callable[[Function], Function]:
    (item,) = (item for item in dataclasses.fields(config) if item.name == name)
    kind = typing.get_type_hints(config)[name]
    flag = "--" + prefix + name.removesuffix("_m").removesuffix("_mps").replace("_", "-")
    if kind is bool:
        flags = f"{flag}/--no-{flag[2:]}" if item.default else flag
        return click.option(
            flags,
            name,
            is_flag=True,
            default=item.default,
            show_default=bool(item.default),
            help=text,
        )
    more: dict[str, Any] = {"default": item.default, "show_default": shown, "help": text}
    if typing.get_origin(kind) is Literal:
        choices = {str(choice): choice for choice in typing.get_args(kind)}
        more |= {"type": Choice(list(choices)), "default": str(item.default)}
        return click.option(
            flag, name, callback=lambda ctx, parameter, value: choices[value], **more
        )
    bounds = item.metadata.get(BOUNDS, Bounds())
    if kind is float:
        return click.option(flag, name, type=Number(bounds), **more)
    if typing.get_origin(kind) is tuple:
        return click.option(flag, name, type=Numbers("X,Y,Z", len(typing.get_args(kind))), **more)
    least, most = (
        None if math.isinf(bound) else int(bound) for bound in (bounds.least, bounds.most)
    )
    return click.option(flag, name, type=click.IntRange(least, most), **more)
