"""Options of commands: options that several commands share, and options made from dataclasses."""

import dataclasses
import json
import math
import re
import typing
from collections.abc import Callable, Collection, Mapping
from functools import reduce, wraps
from pathlib import Path
from typing import Any, Literal

import rich_click as click
from click.core import ParameterSource

from lidarsim.engines import ENGINES
from lidarsim.parameters import BOUNDS, Bounds
from lidarsim.sensors import SENSORS
from scenegen import SPLITS
from scenegen.base.executors import EXECUTORS, LOCAL, cores, executor
from scenegen.base.limits import MAX_WORKERS
from scenegen.cli.types import (
    FILE,
    Choice,
    DatasetPath,
    Named,
    Number,
    Numbers,
    OutputFile,
    OutputFolder,
    Written,
)
from scenegen.worlds.kinds import KINDS
from scenegen.worlds.mapping import Mapper

if typing.TYPE_CHECKING:
    from scenegen.dataset.read import AnyDataset

Decorator = Callable[[Any], Any]
"""Adds options to a function."""

UNITS = re.compile("(_m|_mps|_mps2|_deg_s|_s)$")
"""Unit at the end of a field's name, which its option lacks."""
COMMON_GROUPS = {
    "Sensor and maps": "lidar noise scans scan-spacing fusion map-ahead tilt engine",
    "Options": "",
    "Running and printing": "device workers on json quiet help",
}
"""Groups of options on help pages, below those of the command itself; "Options" holds the rest."""


def group(name: str, options: str) -> Decorator:
    """Group options of a command on its help page.

    Args:
        name: Heading of the group.
        options: Names of the options without dashes, separated by spaces.
    """
    return click.option_panel(name, options=[f"--{option}" for option in options.split()])


def together(*options: Decorator) -> Decorator:
    """Join options to one decorator; the help page lists them in this order."""
    # reversed: the option of the last decorator is listed first
    return lambda function: reduce(
        lambda decorated, option: option(decorated), reversed(options), function
    )


def command(*examples: str) -> Any:
    """Make a function a command. Its help page shows defaults, groups of options, and at the end
    `examples`."""
    lines = "\n\n".join(["Examples:", *(f"scenegen {example}" for example in examples)])
    named = click.command(context_settings={"show_default": True}, epilog=lines)
    # reversed: of decorators, the last is applied first
    groups = [group(name, options) for name, options in COMMON_GROUPS.items()]
    return together(*reversed(groups), named)


WORLD = Named(KINDS, paths=True)
"""Type of a kind's name, or a file of a world."""
dataset_argument = click.argument("dataset", type=DatasetPath())
datasets_argument = click.argument("datasets", nargs=-1, type=DatasetPath())


def workers_by(default: str) -> Decorator:
    """Make the option --workers, whose default is all cores; help pages show `default` for it."""
    kind = click.IntRange(1, MAX_WORKERS)
    # the default is a function: cores are counted when a command runs, not when this is imported
    return click.option(
        "--workers", type=kind, default=cores, show_default=default, help="Processes."
    )


workers_option = workers_by("all cores")
on_option = click.option(
    "--on",
    type=Named(EXECUTORS, address=True),
    default=LOCAL,
    metavar="PLACE",
    help=f"Where the work is done: {', '.join(EXECUTORS.builtin)}, or MODULE:CLASS, each with "
    f"://ADDRESS or without.",
)
force_option = click.option("--force", is_flag=True, help="Replace another dataset in the folder.")
json_option = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
quiet_option = click.option("--quiet", is_flag=True, help="Print errors only.")
device_option = click.option(
    "--device",
    default="auto",
    help="Device to compute on: cpu, cuda, cuda:1 …",
)
columns_option = click.option(
    "--columns",
    type=click.IntRange(3, 64),
    help="For clouds whose columns have no names (.bin, .npy, .npz): how many numbers a point has, "
    "x y z first.  [default: as the format has it, or by the numbers]",
)
difficulty_option = click.option(
    "--difficulty",
    type=Choice(["easy", "medium", "hard"]),
    help="Difficulty of a kind's worlds.  [default: medium]",
)
index_option = click.option(
    "--index",
    "indices",
    multiple=True,
    type=click.IntRange(0),
    help="Number of a sample in its split; repeatable for files.",
)
kind_option = click.option(
    "--kind",
    metavar="MODULE:CLASS",
    help="The dataset's kind, if it is a user's own: its module is imported to draw worlds again.",
)


def printing(function: Callable[..., Any]) -> Any:
    """Add --json and --quiet below all other options.

    The command gets `verbose`, whether to print for people, and `report_result`, to call with its
    result; see `scenegen.cli.show.Reporter`.
    """

    # `wraps` also keeps the options and the help page, which click reads from the function
    @json_option
    @quiet_option
    @wraps(function)
    def _with_printing(*, as_json: bool, quiet: bool, **options: Any) -> Any:
        verbose = not (as_json or quiet)

        def report_result(row: Any) -> bool:
            if as_json:
                # a result that takes time to make is a function
                print(json.dumps(row() if callable(row) else row))
            return verbose

        return function(report_result=report_result, verbose=verbose, **options)

    return _with_printing


def log_options(function: Callable[..., Any]) -> Any:
    """Add --poses, --poses-of, --topic and --fixed-frame. The command gets them as `log_reading`,
    arguments of `scenegen.logs.read.read_log`."""

    @click.option(
        "--poses",
        type=FILE,
        help="File of the log's poses: KITTI's matrices, or columns of TUM, EuRoC, or CSV.",
    )
    @click.option(
        "--poses-of",
        type=Choice(["sensor", "camera"]),
        help="Whether matrices are poses of the sensor, or of the camera, with Tr in calib.txt.  "
        "[default: camera in KITTI's layout]",
    )
    @click.option("--topic", help="Topic of the clouds, if a recording has several.")
    @click.option(
        "--fixed-frame", help="Frame of a recording that poses are in.  [default: the topmost]"
    )
    @wraps(function)
    def _with_log_reading(**options: Any) -> Any:
        names = "poses", "poses_of", "topic", "fixed_frame"
        return function(log_reading={name: options.pop(name) for name in names}, **options)

    return _with_log_reading


def executing(function: Callable[..., Any]) -> Any:
    """Add --workers and --on. The command gets their executor as `execute`."""

    @workers_option
    @on_option
    @wraps(function)
    def _with_executor(*, workers: int, on: str, **options: Any) -> Any:
        return function(execute=executor(on, workers), **options)

    return _with_executor


def split_option(default: str, help: str) -> Decorator:
    """Make the option --split, one of a dataset's splits.

    Args:
        default: The default.
        help: The help text.
    """
    return click.option("--split", type=Choice(SPLITS), default=default, help=help)


def splits_option(help: str) -> Decorator:
    """Make a repeatable option --split; its parameter is `splits`."""
    return click.option(
        "--split",
        "splits",
        type=Choice(SPLITS),
        multiple=True,
        help=f"{help}; repeatable.  [default: all]",
    )


def seed_option(help: str) -> Decorator:
    """Make the option --seed."""
    return click.option("--seed", type=click.IntRange(min=0), default=0, help=help)


def out_option(
    help: str, *ends: str, file: bool = False, stores: bool = False, **settings: Any
) -> Decorator:
    """Make the option -o for a file or folder to write; its parameter is `out`.

    Args:
        help: The help text.
        ends: Suffixes that a file must have.
        file: Whether it is a file of any suffix; a folder without this and `ends`.
        stores: Whether a folder may be in a store.
        settings: Further arguments of `click.option`.
    """
    file = file or bool(ends)
    kind = OutputFile(*ends) if file else OutputFolder(stores=stores)
    names = ("--output", "--out") if file else ("--out", "--output")
    return click.option("-o", *names, "out", type=kind, help=help, **settings)


def lidar_option(default: str) -> Decorator:
    """Make the option --lidar, or --sensor; its parameter is `lidar`, a text for `named_lidar`.
    Help pages show `default`."""
    return click.option(
        *("--lidar", "--sensor", "lidar"),
        type=Named(SENSORS, file=".toml"),
        help="The sensor: a name (`scenegen sensors` lists them), a .toml file, or MODULE:CLASS."
        f"  [default: {default}]",
    )


def engine_option(help: str, **settings: Any) -> Decorator:
    """Make the option --engine.

    Args:
        help: The help text.
        settings: Further arguments of `click.option`.
    """
    return click.option("--engine", type=Named(ENGINES), help=help, **settings)


def _noise(text: str) -> str:
    """Check that each stage of a noise can be parsed, and return the text. The chain is made later,
    when the sensor is known."""
    from lidarsim.noise.chain import DATASHEET, Noise

    for stage in text.split(","):
        if stage.strip() != DATASHEET:
            Noise.parse(stage)
    return text


noise_option = click.option(
    "--noise",
    type=Written(_noise, "STAGE:VALUE…,…"),
    help="Noise of the sensor, such as range:0.02,dropout:0.05; or datasheet for the noise in its "
    "data sheet.  [default: none]",
)


def mapping_options(default: str | None = None) -> Decorator:
    """Make the options of how scans become a map; for `default` see `options_of`."""
    return options_of(
        Mapper,
        default=default,
        scans="Number of scans in a map: the sample's own, and those before it on the flight.",
        scan_spacing_m="Distance flown between scans, metres.",
        fusion="How several scans make one map.",
        map_ahead_m="Position of the map's centre from the sensor: metres forward, to the left, "
        "and up.",
    )


def mapping_given(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of `mapping_options` that the user gave."""
    return {name: value for name, value in fields_in(Mapper, options).items() if was_given(name)}


def options_of(
    config: type,
    prefix: str = "",
    *,
    default: str | None = None,
    **helps: str,
) -> Decorator:
    """Make an option of each field of a dataclass that `helps` names.

    Default, type, choices and bounds are those of the field. The option's name is `prefix` and the
    field's name without its unit: `beta_m` becomes --beta. Tuples are numbers separated by commas.

    Args:
        config: The dataclass.
        prefix: Begin of the options' names.
        default: Text to show as the default, if an omitted option means something else than the
            field's default.
        helps: Help texts by the fields' names.
    """
    kinds = typing.get_type_hints(config)  # annotations may be texts
    fields = {item.name: item for item in dataclasses.fields(config)}
    options = []
    for name, text in helps.items():
        flag = "--" + prefix + UNITS.sub("", name).replace("_", "-")
        settings = _settings(kinds[name], fields[name], flag)
        settings |= {"show_default": default} if default else {}
        options.append(click.option(settings.pop("flag", flag), name, help=text, **settings))
    return together(*options)


def _settings(kind: Any, field: Any, flag: str) -> dict[str, Any]:
    """Return the arguments of `click.option` for a field of a dataclass."""
    default = field.default
    if kind is bool:  # a field that is true by default needs a flag to switch it off
        names = {"flag": f"{flag}/--no-{flag[2:]}"} if default else {}
        return {**names, "is_flag": True, "default": default}
    if typing.get_origin(kind) is Literal:
        words = {str(choice): choice for choice in typing.get_args(kind)}
        return {
            "type": Choice(list(words)),
            "default": str(default),
            # choices are texts; the field may have numbers
            "callback": lambda ctx, parameter, value: words[value],
        }
    bounds = field.metadata.get(BOUNDS, Bounds())
    if kind is float:
        return {"type": Number(bounds), "default": default}
    if typing.get_origin(kind) is tuple:
        return {"type": Numbers(name="X,Y,Z"), "default": default}
    low, high = (
        None if math.isinf(bound) else int(bound) for bound in (bounds.minimum, bounds.maximum)
    )
    return {"type": click.IntRange(low, high), "default": default}


def fields_in(config: type, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that are fields of a dataclass.

    Args:
        config: The dataclass.
        options: Values by name.
    """
    return {
        item.name: options[item.name] for item in dataclasses.fields(config) if item.name in options
    }


def without(config: type, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that are not fields of a dataclass.

    Args:
        config: The dataclass.
        options: Values by name.
    """
    return {name: options[name] for name in options.keys() - fields_in(config, options)}


def was_given(name: str) -> bool:
    """Whether the user gave a parameter of the current command, rather than its default."""
    return bool(flags_given([name]))


def flags_given(names: Collection[str]) -> list[str]:
    """Return those parameters among `names` that the user gave to the current command, as flags
    such as --host."""
    context: Any = click.get_current_context()
    source = context.get_parameter_source
    return [
        option.opts[0]
        for option in context.command.params
        if option.name in names and source(option.name) is not ParameterSource.DEFAULT
    ]


def open_dataset(dataset: Path | str, *, show_progress: bool, partial: bool = True) -> "AnyDataset":
    """Open a dataset, collection or selection, and download it if needed.

    Args:
        dataset: Path or name.
        show_progress: Whether a download shows a bar.
        partial: Whether an incomplete dataset is allowed.

    Raises:
        DatasetError: There is no such dataset, or it is damaged.
    """
    from scenegen.dataset.collection import open_data

    return open_data(dataset, partial=partial, show_progress=show_progress)


def find_datasets(
    datasets: tuple[Path | str, ...], *, show_progress: bool
) -> "tuple[AnyDataset, ...]":
    """Open datasets, by default those under data/ that have samples.

    Args:
        datasets: Paths or names.
        show_progress: Whether a download shows a bar, and empty datasets a note.

    Raises:
        UsageError: No dataset is given, and data/ has none.
        DatasetError: One does not exist, or is damaged.
    """
    from scenegen.cli.show import info
    from scenegen.dataset.collection import open_data

    opened = [open_data(dataset, show_progress=show_progress) for dataset in datasets]
    # datasets found here may be empty, and are left out; an incomplete one is refused, as usual
    for path in () if opened else sorted(Path("data").glob("*/dataset.json")):
        candidate = open_data(path.parent, partial=True)
        if any(len(candidate.split(split)) for split in SPLITS):
            opened.append(open_data(path.parent))
        elif show_progress:
            info(f"{path.parent}: holds no samples yet, so it is left out")
    if not opened:
        raise click.UsageError(
            "no dataset given, and none under data/; make one: `scenegen generate --kind pillar`"
        )
    return tuple(opened)
