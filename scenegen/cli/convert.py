"""`scenegen convert`, `world`, `map` and `ingest`: datasets and worlds for other programs, and
point clouds and logs of a real sensor as maps to make datasets in."""

import sys
from pathlib import Path
from shlex import quote
from typing import Any

import rich_click as click

from scenegen import SPLITS
from scenegen.base.errors import raised_as
from scenegen.base.executors import Executor
from scenegen.base.paths import type_of
from scenegen.cli.options import (
    columns_option,
    command,
    dataset_argument,
    executing,
    group,
    log_options,
    open_dataset,
    options_of,
    out_option,
    printing,
    quiet_option,
    split_option,
    splits_option,
    was_given,
)
from scenegen.cli.show import Progress, Tell, note, plain, say, show_table
from scenegen.cli.types import FILE, Named, Number
from scenegen.convert import FORMATS, Choices
from scenegen.logs import Fusing
from scenegen.worlds.cloud import Survey


@command(
    "convert data/pillar --to ply",
    "convert data/pillar --to rerun --split val",
)
@dataset_argument
@click.option(
    "--to",
    "to",
    type=Named(FORMATS),
    required=True,
    help=f"The format: {', '.join(FORMATS.builtin)}, or MODULE:CLASS.",
)
@out_option("The folder to write.  [default: the dataset's name, a dash, the format]")
@splits_option("A split")
@options_of(
    Choices,
    unseen_invalid="SemanticKITTI: mark voxels that no ray met as invalid, which leaves them out "
    "of its score.",
    label="SemanticKITTI: the label of occupied voxels without a class, or of one that it lacks.",
    frame="Frame of points.",
)
@executing
@quiet_option
@group("SemanticKITTI", "unseen-invalid label")
def convert(
    dataset: Path | str,
    to: str,
    out: Path | None,
    splits: tuple[str, ...],
    execute: Executor,
    quiet: bool,
    **options: Any,
) -> None:
    """Write a dataset in another program's format; the same command again goes on where it was
    stopped.
    """
    from scenegen.base.errors import DatasetError, plural
    from scenegen.convert.convert import convert as write

    source = open_dataset(dataset, shown=not quiet)
    target = out or Path(f"{Path(source.name).absolute().stem}-{to.rpartition(':')[2]}")
    for one in source.datasets:
        if not one.manifest.complete:
            note(f"{one.folder}: is incomplete; what is there is converted")
    with Progress(to, shown=not quiet) as progress:
        done = write(
            source,
            target,
            to=to,
            choices=Choices(**options),
            splits=splits or SPLITS,
            execute=execute,
            on_start=progress.start,
            on_done=progress.count,
        )
    for line in (*(done.notes if not quiet else ()), *done.broken):
        note(line)
    if done.broken:
        raise DatasetError(
            f"{source.name}: {len(done.broken)} samples could not be read; the others are in "
            f"{target}"
        )
    if not quiet:
        others = f"; {done.others} are for the other ranks to write there" if done.others else ""
        before = f"; an earlier run wrote {done.there}" if done.there else ""
        say(f"{target}: {plural(done.written, 'samples')} written{before}{others}")


@command("world data/pillar 3 -o world.xml", "world scenes/forest.xml -o forest.glb")
@dataset_argument
@click.argument("number", type=click.IntRange(min=0), required=False)
@split_option("train", help="The split that the world belongs to.")
@out_option(
    "File to write: MJCF (.xml), or its surfaces (.glb).  [default: MJCF to standard output]",
    ".xml",
    ".glb",
)
def world(dataset: Path | str, number: int | None, split: str, out: Path | None) -> None:
    """Take one world's MJCF, and the files it refers to, out of a dataset.

    With a name that ends in .glb, write its surfaces instead, or those of an MJCF file (.xml).
    """
    alone = type_of(dataset) == "world"
    surfaces = out is not None and out.suffix == ".glb"
    if alone and not surfaces:
        raise click.UsageError(
            f"{dataset}: is a world already; give -o with a name that ends in .glb"
        )
    if alone == (number is not None):
        raise click.UsageError(
            "give the number of one of the dataset's worlds, and none for an .xml file"
        )
    if out is not None and surfaces:
        from scenegen.base.files import write_result
        from scenegen.draw.source import read_world
        from scenegen.view.glb import encode_world
        from scenegen.worlds.world import solid

        compiled = (
            read_world(Path(dataset))
            if number is None
            else open_dataset(dataset, shown=True).compile(split, number)
        )
        write_result(out, encode_world(solid(compiled, str(dataset))))
        say(f"written: {out}")
        return
    from scenegen.dataset.archive import DOCUMENT, write_extracted

    assert number is not None
    files = open_dataset(dataset, shown=True).world(split, number)
    if out is not None:
        write_extracted(files, out)
        say(f"written: {out}" + (f", {out.with_suffix('.files')}/" if len(files) > 1 else ""))
    elif len(files) > 1:
        raise click.UsageError(
            f"this world refers to {len(files) - 1} other files; give -o: they go beside it"
        )
    else:
        sys.stdout.buffer.write(files[DOCUMENT])


@command(
    "map hall.pcd -o hall.npz",
    "map drive/*.ply --poses poses.txt --voxel 0.1 -o drive.npz",
    "map tile.laz --assume-free --voxel 0.5 -o tile.npz",
    "map lab.yaml --height 2.5 -o lab.npz",
)
@click.argument("clouds", nargs=-1, required=True, type=FILE)
@click.option("--sensor", type=(Number(),) * 3, help="Where the clouds' sensor was: X Y Z.")
@click.option(
    "--poses",
    type=FILE,
    help="A text file with a line for each cloud: x y z of its sensor; or, for clouds in their "
    "sensor's frame, its pose as TUM or KITTI write it.",
)
@click.option(
    "--box",
    type=(Number(),) * 6,
    help="Leave out what lies beyond these two corners: X Y Z X Y Z.",
)
@columns_option
@options_of(
    Survey,
    voxel_m="Edge of the map's voxels, metres.",
    unit_m="The clouds' unit, metres: 0.001 for millimetres.",
    up="The clouds' axis that points up.",
    least_m="Points nearer than this to the sensor that saw them are no returns, metres.",
    height_m="How high the walls of a plan are, metres.",
    assume_free="Call free what is above the lowest point of a column and holds none, unless a ray "
    "says so already: for clouds of which nobody knows where they were seen from.",
)
@out_option("The map to write, .npz.", ".npz", default="map.npz")
@printing
@group("Clouds", "sensor poses least box columns unit up")
def map(
    clouds: tuple[Path, ...],
    sensor: tuple[float, ...] | None,
    poses: Path | None,
    box: tuple[float, ...] | None,
    columns: int | None,
    out: Path,
    tell: Tell,
    talk: bool,
    **options: Any,
) -> None:
    """Make a map of a real place from point clouds: .ply, .pcd, .las, .laz, .bin, .xyz, .npz, .npy;
    or from one of ROS's plans of a floor, .yaml.

    Voxels with points are occupied, those that rays from the sensor crossed are free, and all
    others unknown. `scenegen generate --scene` takes the map.
    """
    if sensor is not None and poses is not None:
        raise click.UsageError("--sensor and --poses both say where sensors were; give one")
    plan = clouds[0].suffix == ".yaml"
    options_given = set(filter(was_given, ("sensor", "poses", "box", "columns", *options)))
    misplaced = options_given - {"height_m"} if plan else options_given & {"height_m"}
    if misplaced or (plan and len(clouds) > 1):
        raise click.UsageError(
            "a plan, .yaml, is given alone, with --height and no other of these options, which are "
            "for clouds"
        )
    from scenegen.base.files import write_result
    from scenegen.view.inspect import map_facts
    from scenegen.worlds.cloud import map_clouds
    from scenegen.worlds.place import encode_map
    from scenegen.worlds.plan import read_plan

    survey = Survey(**options)
    if plan:
        made = read_plan(clouds[0], survey.height_m)
    else:
        made = map_clouds(clouds, survey, sensor=sensor, poses=poses, box=box, columns=columns)
    write_result(out, encode_map(made.voxels, str(clouds[0]), offset=made.offset))
    about = {"file": str(out), "points": made.points, "taken_off_m": made.offset.tolist()}
    row = about | map_facts(made.voxels)
    if talk:
        note(made.read)
    if tell(row | {"read": made.read}):
        show_table(plain(row) | {"next": f"scenegen generate --scene {quote(str(out))}"})


@command(
    "ingest dataset/sequences/07 -o data/kitti-07",
    "ingest drive.mcap --deskew -o data/drive",
    "ingest clouds --poses poses.tum -o data/walk",
)
@click.argument("log", type=FILE)
@log_options
@columns_option
@options_of(
    Fusing,
    voxel_m="Edge of the maps' voxels, metres.",
    reach_m="How far rays are followed, metres.",
    rise_m="How far maps go above and below the sensor, metres.",
    least_m="Nearer returns are left out, metres.",
    moved_share="A voxel is free where fewer of the scans that say something of it have a return "
    "in it.",
    every="Every n-th scan is kept beside the truth.",
    deskew="Move points to where their rays met something, by the time of each: for raw scans.",
)
@click.option(
    "--explain",
    is_flag=True,
    help="Print how points, poses and times are read, and write nothing.",
)
@out_option("The folder to write, a new one.  [default: <log>-maps]")
@printing
@group("Log", "poses poses-of topic fixed-frame columns deskew explain")
@group("Maps", "voxel reach rise least moved-share")
def ingest(
    log: Path,
    log_reading: dict[str, Any],
    columns: int | None,
    explain: bool,
    out: Path | None,
    tell: Tell,
    talk: bool,
    **options: Any,
) -> None:
    """Make maps of a log of LiDAR scans with poses, and keep some of its scans beside them.

    A log is a sequence in KITTI's odometry layout (SemanticKITTI's, too), a recording of ROS
    (.mcap, .bag, .db3, or a bag's folder) with PointCloud2 or Livox's CustomMsg and /tf, odometry
    or --poses, or a folder of clouds with --poses. Stopped or killed, the same command goes on.
    """
    from scenegen.base.files import check_free
    from scenegen.logs.fuse import ingest as write
    from scenegen.logs.read import read_log

    target = out or Path(f"{log.stem}-maps")
    with raised_as(click.UsageError):
        how = Fusing(**options)
    if not explain:
        check_free(target)
    recording = read_log(log, columns=columns, **log_reading)
    if explain:
        row = recording.explained()
        if tell(row):
            show_table(row)
    elif talk:
        note(recording.line())
    if how.deskew:
        recording.check_point_times()
    if explain:
        return
    with Progress("ingest", shown=talk) as progress:
        progress.start(len(recording.poses))
        counts = write(recording, target, how, on_done=progress.count)
    if tell({"folder": str(target), "read": dict(recording.about), **counts}):
        source, folder = quote(str(target)), quote(f"{target}-samples")
        show_table(plain(counts) | {"next": f"scenegen generate --scene {source} -o {folder}"})
