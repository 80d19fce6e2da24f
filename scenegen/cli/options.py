"""Options of commands: those that several share, and those that are fields of a configuration."""

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
from scenegen.base.limits import MOST_WORKERS
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
    from scenegen.dataset.read import AnyDataset, Dataset

Decorator = Callable[[Any], Any]
"""Makes of a function the same one with more options."""

UNITS = re.compile("(_m|_mps|_mps2|_deg_s)$")
"""How the names of fields end that are options without it."""
COMMON_GROUPS = {
    "Sensor and maps": "lidar noise scans scan-spacing fusion map-ahead tilt engine",
    "Options": "",
    "Running and printing": "device workers on json quiet help",
}
"""Groups of options on help pages, below those of the command itself; "Options" holds the rest."""


def group(name: str, options: str) -> Decorator:
    """Groups options of a command, their names in one text, under `name` on its help page."""
    return click.option_panel(name, options=[f"--{option}" for option in options.split()])


def together(*options: Decorator) -> Decorator:
    """Several options as one decorator, listed in this order."""
    return lambda function: reduce(lambda made, option: option(made), reversed(options), function)


def command(*examples: str) -> Any:
    """Makes a function a command whose help page shows defaults, has groups of options, and ends
    with `examples`."""
    lines = "\n\n".join(["Examples:", *(f"scenegen {example}" for example in examples)])
    named = click.command(context_settings={"show_default": True}, epilog=lines)
    # reversed: of decorators, the last is applied first
    groups = [group(name, options) for name, options in COMMON_GROUPS.items()]
    return together(*reversed(groups), named)


WORLD = Named(KINDS, paths=True)
"""A kind's name, or a file of a world."""
dataset_argument = click.argument("dataset", type=DatasetPath())
datasets_argument = click.argument("datasets", nargs=-1, type=DatasetPath())


def workers_by(default: str) -> Decorator:
    """--workers, all cores unless given; help pages show the text `default`."""
    kind = click.IntRange(1, MOST_WORKERS)
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
    help="Where to compute: cpu, cuda, cuda:1 …",
)
columns_option = click.option(
    "--columns",
    type=click.IntRange(3, 64),
    help="For clouds whose columns have no names (.bin, .npy, .npz): the numbers of a point, x y z "
    "first.  [default: as the format has it, or by the numbers]",
)
difficulty_option = click.option(
    "--difficulty",
    type=Choice(["easy", "medium", "hard"]),
    help="How hard a kind's worlds are.  [default: medium]",
)
index_option = click.option(
    "--index",
    "indices",
    multiple=True,
    type=click.IntRange(0),
    help="A sample's number; in a file, repeatable.",
)
kind_option = click.option(
    "--kind",
    metavar="MODULE:CLASS",
    help="The dataset's own kind, where it is not one of scenegen's: its module is imported to "
    "draw worlds again.",
)


def printing(function: Callable[..., Any]) -> Any:
    """--json and --quiet, below all other options. The command is told by `talk` whether to print
    for people, and says what came of it by `tell`."""

    @json_option
    @quiet_option
    @wraps(function)
    def command(*, as_json: bool, quiet: bool, **options: Any) -> Any:
        talk = not (as_json or quiet)

        def tell(row: Any) -> bool:
            if as_json:
                print(json.dumps(row() if callable(row) else row))
            return talk

        return function(tell=tell, talk=talk, **options)

    return command


def log_options(function: Callable[..., Any]) -> Any:
    """--poses, --poses-of, --topic and --fixed-frame. The command gets them as `log_reading`, the
    arguments of `scenegen.logs.read.read_log`."""

    @click.option(
        "--poses",
        type=FILE,
        help="The poses of a log, as matrices of KITTI's, or as columns of TUM's, EuRoC's, or CSV.",
    )
    @click.option(
        "--poses-of",
        type=Choice(["sensor", "camera"]),
        help="What matrices are of: the sensor, or the camera, moved by Tr of calib.txt.  "
        "[default: camera in KITTI's layout]",
    )
    @click.option("--topic", help="The clouds of a recording that has several.")
    @click.option(
        "--fixed-frame", help="The frame of a recording that poses are in.  [default: the topmost]"
    )
    @wraps(function)
    def command(**options: Any) -> Any:
        names = "poses", "poses_of", "topic", "fixed_frame"
        return function(log_reading={name: options.pop(name) for name in names}, **options)

    return command


def executing(function: Callable[..., Any]) -> Any:
    """--workers and --on. The command is given `execute`, which works there."""

    @workers_option
    @on_option
    @wraps(function)
    def command(*, workers: int, on: str, **options: Any) -> Any:
        return function(execute=executor(on, workers), **options)

    return command


def split_option(default: str, help: str) -> Decorator:
    """--split, one of a dataset's."""
    return click.option("--split", type=Choice(SPLITS), default=default, help=help)


def splits_option(help: str) -> Decorator:
    """--split, repeatable; the parameter is `splits`."""
    return click.option(
        "--split",
        "splits",
        type=Choice(SPLITS),
        multiple=True,
        help=f"{help}; repeatable.  [default: all]",
    )


def seed_option(help: str) -> Decorator:
    """--seed of what is drawn."""
    return click.option("--seed", type=click.IntRange(min=0), default=0, help=help)


def out_option(
    help: str, *ends: str, file: bool = False, stores: bool = False, **more: Any
) -> Decorator:
    """-o: the folder, with `stores` also one in a store, or, with `file` or the `ends` of its name,
    the file to write; the parameter is `out`."""
    file = file or bool(ends)
    kind = OutputFile(*ends) if file else OutputFolder(stores=stores)
    names = ("--output", "--out") if file else ("--out", "--output")
    return click.option("-o", *names, "out", type=kind, help=help, **more)


def lidar_option(default: str) -> Decorator:
    """--lidar, or --sensor: a sensor's name, a TOML file of one, or module:Object; the parameter is
    `lidar`."""
    return click.option(
        *("--lidar", "--sensor", "lidar"),
        type=Named(SENSORS, file=".toml"),
        help="The sensor: a name (`scenegen sensors` lists them), a .toml file, or MODULE:CLASS."
        f"  [default: {default}]",
    )


def engine_option(help: str, **more: Any) -> Decorator:
    """--engine, by name or as MODULE:CLASS."""
    return click.option("--engine", type=Named(ENGINES), help=help, **more)


def _noise(text: str) -> str:
    """The text as it is, if each of its stages can be read; the chain is made once the sensor is
    known."""
    from lidarsim.noise.chain import DATASHEET, Noise

    for stage in text.split(","):
        if stage.strip() != DATASHEET:
            Noise.parse(stage)
    return text


noise_option = click.option(
    "--noise",
    type=Written(_noise, "STAGE:VALUE…,…"),
    help="Faults of the sensor, such as range:0.02,dropout:0.05, or datasheet for what it comes "
    "with.  [default: none]",
)


def mapping_options(default: str | None = None) -> Decorator:
    """Options of how maps are made, of commands that draw or scan again; for `default` see
    `options_of`."""
    return options_of(
        Mapper,
        default=default,
        scans="Scans that make a map: the sample's own, and those before it on the flight.",
        scan_spacing_m="Metres flown from scan to scan.",
        fusion="How several scans make one map.",
        map_ahead_m="Where the map's middle lies from the sensor: metres forward, to the left, "
        "and up.",
    )


def mapping_given(options: Mapping[str, Any]) -> dict[str, Any]:
    """Those of `options` that the user gave and that say how maps are made."""
    return {name: value for name, value in taken(Mapper, options).items() if was_given(name)}


def options_of(
    config: type,
    prefix: str = "",
    *,
    default: str | None = None,
    **helps: str,
) -> Decorator:
    """Makes an option of each field of a dataclass that `helps` names.

    Its default, type, choices and bounds are the field's; so is its name, after `prefix` and
    without a unit: `beta_m` becomes --beta. Several numbers are given with commas between.

    Args:
        config: The dataclass.
        prefix: What the options' names begin with.
        default: Shown where an option that is not given has another effect than the field's
            default.
        helps: The options' texts by the fields' names.
    """
    kinds = typing.get_type_hints(config)
    fields = {item.name: item for item in dataclasses.fields(config)}
    options = []
    for name, text in helps.items():
        flag = "--" + prefix + UNITS.sub("", name).replace("_", "-")
        more = _settings(kinds[name], fields[name], flag)
        more |= {"show_default": default} if default else {}
        options.append(click.option(more.pop("flag", flag), name, help=text, **more))
    return together(*options)


def _settings(kind: Any, field: Any, flag: str) -> dict[str, Any]:
    """What click is told of an option that is a dataclass's field."""
    default = field.default
    if kind is bool:
        both = {"flag": f"{flag}/--no-{flag[2:]}"} if default else {}
        return {**both, "is_flag": True, "default": default}
    if typing.get_origin(kind) is Literal:
        words = {str(choice): choice for choice in typing.get_args(kind)}
        return {
            "type": Choice(list(words)),
            "default": str(default),
            "callback": lambda ctx, parameter, value: words[value],
        }
    bounds = field.metadata.get(BOUNDS, Bounds())
    if kind is float:
        return {"type": Number(bounds), "default": default}
    if typing.get_origin(kind) is tuple:
        return {"type": Numbers(name="X,Y,Z"), "default": default}
    least, most = (
        None if math.isinf(bound) else int(bound) for bound in (bounds.least, bounds.most)
    )
    return {"type": click.IntRange(least, most), "default": default}


def taken(config: type, options: Mapping[str, Any]) -> dict[str, Any]:
    """Those of `options` that are fields of the dataclass `config`."""
    return {
        item.name: options[item.name] for item in dataclasses.fields(config) if item.name in options
    }


def without(config: type, options: Mapping[str, Any]) -> dict[str, Any]:
    """Those of `options` that are no fields of the dataclass `config`."""
    return {name: options[name] for name in options.keys() - taken(config, options)}


def was_given(name: str) -> bool:
    """Whether the user gave the current command's parameter `name`, by whatever means."""
    return bool(flags_given([name]))


def flags_given(names: Collection[str]) -> list[str]:
    """Those of the current command's parameters `names` that the user gave, as they are typed."""
    context: Any = click.get_current_context()
    source = context.get_parameter_source
    return [
        option.opts[0]
        for option in context.command.params
        if option.name in names and source(option.name) is not ParameterSource.DEFAULT
    ]


def open_dataset(dataset: Path | str, *, shown: bool, partial: bool = True) -> "AnyDataset":
    """The dataset, collection or selection named, fetched where it is not here; with `shown`, a
    download has a bar. Without `partial`, it must be complete."""
    from scenegen.dataset.collection import open_data

    return open_data(dataset, partial=partial, shown=shown)


def one_dataset(dataset: Path | str, *, shown: bool, partial: bool = True) -> "Dataset":
    """See `open_dataset`, for commands of one dataset alone. Raises UsageError for several."""
    from scenegen.dataset.read import Dataset

    opened = open_dataset(dataset, shown=shown, partial=partial)
    if not isinstance(opened, Dataset):
        names = ", ".join(one.name for one in opened.datasets)
        raise click.UsageError(f"{opened.name}: is of several, or a selection; give one of {names}")
    return opened


def find_datasets(datasets: tuple[Path | str, ...], *, shown: bool) -> "tuple[AnyDataset, ...]":
    """The datasets named, or those under data/ that hold samples. Raises UsageError for none."""
    from scenegen.cli.show import note
    from scenegen.dataset.collection import open_data

    opened = [open_data(dataset, shown=shown) for dataset in datasets]
    for path in () if opened else sorted(Path("data").glob("*/dataset.json")):
        one = open_data(path.parent, partial=True)
        if any(len(one.split(split)) for split in SPLITS):
            opened.append(open_data(path.parent))
        elif shown:
            note(f"{path.parent}: holds no samples yet, so it is left out")
    if not opened:
        raise click.UsageError(
            "no dataset given, and none under data/; make one: `scenegen generate --kind pillar`"
        )
    return tuple(opened)
