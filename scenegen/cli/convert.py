"""`scenegen convert` and `world` write datasets and worlds for other programs; `map` and `ingest`
make maps of point clouds and logs of real sensors."""

import sys
from pathlib import Path
from shlex import quote
from typing import Any

import rich_click as click

from scenegen import SPLITS
from scenegen.base.errors import reraise_as
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
from scenegen.cli.show import ProgressBar, Reporter, echo, info, plain, show_table
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
    unseen_invalid="SemanticKITTI: mark voxels that no ray met as invalid, so that its score "
    "ignores them.",
    label="SemanticKITTI: label of occupied voxels without a class, or with one that it lacks.",
    frame="Frame of points.",
    future="npz, webdataset, occ3d: add the velocity of each voxel, and occupancy 0.5, 1 and 2 s "
    "later, of datasets with movers.",
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
    """Write a dataset in another program's format; the same command continues a stopped run.

    \f
    Raises:
        DatasetError: The folder has another conversion, or a sample cannot be read; the others are
            written.
    """
    from scenegen.base.errors import DatasetError, plural
    from scenegen.convert.convert import convert as write

    source = open_dataset(dataset, show_progress=not quiet)
    # of MODULE:CLASS, the class
    target = out or Path(f"{Path(source.name).absolute().stem}-{to.rpartition(':')[2]}")
    for part in source.datasets:
        if not part.manifest.complete:
            info(f"{part.folder}: is incomplete; its samples so far are converted")
    with ProgressBar(to, visible=not quiet) as progress:
        result = write(
            source,
            target,
            to=to,
            choices=Choices(**options),
            splits=splits or SPLITS,
            execute=execute,
            on_start=progress.start,
            on_done=progress.count,
        )
    for line in (*(result.notes if not quiet else ()), *result.broken):
        info(line)
    if result.broken:
        raise DatasetError(
            f"{source.name}: {len(result.broken)} samples could not be read; the others are in "
            f"{target}"
        )
    if not quiet:
        remaining = (
            f"; {result.of_other_ranks} are for the other ranks to write there"
            if result.of_other_ranks
            else ""
        )
        before = f"; an earlier run wrote {result.existing}" if result.existing else ""
        echo(f"{target}: {plural(result.written, 'samples')} written{before}{remaining}")


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
    """Write the MJCF of one world of a dataset, and the files it refers to.

    With a name that ends in .glb, write its surfaces instead, or those of an MJCF file (.xml).

    \f
    Raises:
        UsageError: A number for a file, or none for a dataset; or MJCF with other files for
            standard output.
        ScenegenError: There is no such world, or it cannot be compiled.
    """
    is_file = type_of(dataset) == "world"  # an .xml file has one world, without a number
    surfaces = out is not None and out.suffix == ".glb"
    if is_file and not surfaces:
        raise click.UsageError(
            f"{dataset}: is a world already; give -o with a name that ends in .glb"
        )
    if is_file == (number is not None):
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
            else open_dataset(dataset, show_progress=True).compile(split, number)
        )
        write_result(out, encode_world(solid(compiled, str(dataset))))
        echo(f"written: {out}")
        return
    from scenegen.dataset.archive import DOCUMENT, write_extracted

    assert number is not None
    files = open_dataset(dataset, show_progress=True).world(split, number)
    if out is not None:
        write_extracted(files, out)
        echo(f"written: {out}" + (f", {out.with_suffix('.files')}/" if len(files) > 1 else ""))
    elif len(files) > 1:  # standard output can carry only the document
        raise click.UsageError(
            f"this world refers to {len(files) - 1} other files; give -o, to write them beside it"
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
@click.option("--sensor", type=(Number(),) * 3, help="Position of the clouds' sensor: X Y Z.")
@click.option(
    "--poses",
    type=FILE,
    help="A text file with a line for each cloud: x y z of its sensor; or, for clouds in the "
    "sensor's frame, the sensor's pose in TUM's or KITTI's format.",
)
@click.option(
    "--box",
    type=(Number(),) * 6,
    help="Leave out points outside the box with these two corners: X Y Z X Y Z.",
)
@columns_option
@options_of(
    Survey,
    voxel_m="Edge of the map's voxels, metres.",
    unit_m="The clouds' unit, metres: 0.001 for millimetres.",
    up="The clouds' axis that points up.",
    least_m="Points nearer to their sensor than this are left out, metres.",
    height_m="Height of the walls of a plan, metres.",
    assume_free="Assume that voxels without points above the lowest point of a column are free: "
    "for clouds whose sensor positions are not known.",
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
    report_result: Reporter,
    verbose: bool,
    **options: Any,
) -> None:
    """Make a map of a real place from point clouds: .ply, .pcd, .las, .laz, .bin, .xyz, .npz, .npy;
    or from a floor plan of ROS, .yaml.

    Voxels with points are occupied, those that rays from the sensor crossed are free, and all
    others are unknown. `scenegen generate --scene` takes the map.

    \f
    Raises:
        UsageError: Options contradict each other, or are for the other kind of file.
        SceneError: A file cannot be read, or the map would be too large.
    """
    if sensor is not None and poses is not None:
        raise click.UsageError("--sensor and --poses both say where sensors were; give one")
    plan = clouds[0].suffix == ".yaml"
    options_given = set(filter(was_given, ("sensor", "poses", "box", "columns", *options)))
    # a plan has its own scale and origin; only its walls need a height
    misplaced = options_given - {"height_m"} if plan else options_given & {"height_m"}
    if misplaced or (plan and len(clouds) > 1):
        raise click.UsageError(
            "a plan, .yaml, is given alone, with --height and no other of these options: they are "
            "for clouds"
        )
    from scenegen.base.files import write_result
    from scenegen.view.inspect import map_facts
    from scenegen.worlds.cloud import map_clouds
    from scenegen.worlds.place import encode_map
    from scenegen.worlds.plan import read_plan

    survey = Survey(**options)
    if plan:
        result = read_plan(clouds[0], survey.height_m)
    else:
        result = map_clouds(clouds, survey, sensor=sensor, poses=poses, box=box, columns=columns)
    write_result(out, encode_map(result.voxels, str(clouds[0]), offset=result.offset))
    facts = {"file": str(out), "points": result.points, "taken_off_m": result.offset.tolist()}
    row = facts | map_facts(result.voxels)
    if verbose:
        info(result.read)
    if report_result(row | {"read": result.read}):
        show_table(plain(row) | {"next": f"scenegen generate --scene {quote(str(out))}"})


@command(
    "ingest dataset/sequences/07 -o data/kitti-07",
    "ingest drive.mcap --deskew -o data/drive",
    "ingest clouds --poses poses.tum -o data/walk",
)
@click.argument("log", type=FILE)
@log_options
@click.option(
    "--align", is_flag=True, help="Find the poses: register each scan to those before it."
)
@columns_option
@options_of(
    Fusing,
    voxel_m="Edge of the maps' voxels, metres.",
    reach_m="Maximum length of a ray, metres.",
    rise_m="Height of maps above the sensor, and their depth below it, metres.",
    least_m="Nearer returns are left out, metres.",
    moved_share="A voxel is free if a smaller share of the scans that observed it have a return "
    "in it: a moving object was there.",
    every="Every n-th scan is written with its truth.",
    deskew="Correct points for the sensor's motion during a scan, by the time of each: for raw "
    "scans.",
)
@click.option(
    "--explain",
    is_flag=True,
    help="Print how points, poses and times are read, and write nothing.",
)
@out_option("The folder to write, a new one.  [default: <log>-maps]")
@printing
@group("Log", "poses align poses-of topic fixed-frame columns deskew explain")
@group("Maps", "voxel reach rise least moved-share")
def ingest(
    log: Path,
    log_reading: dict[str, Any],
    align: bool,
    columns: int | None,
    explain: bool,
    out: Path | None,
    report_result: Reporter,
    verbose: bool,
    **options: Any,
) -> None:
    """Make maps of a log of LiDAR scans with poses, and write some of its scans with their truth.

    A log is a sequence in the layout of KITTI's odometry or SemanticKITTI; a recording of ROS
    (.mcap, .bag, .db3, or a bag's folder) with PointCloud2 or Livox's CustomMsg, and /tf, odometry
    or --poses; or a folder of clouds with --poses. With --align, none of them needs poses. The same
    command continues a stopped run.

    \f
    Raises:
        UsageError: A scan would not fit into memory.
        DatasetError: The log cannot be read, or the folder exists.
        SceneError: No return is within reach of the sensor.
    """
    from scenegen.base.files import check_free
    from scenegen.logs.fuse import ingest as write
    from scenegen.logs.read import read_log

    target = out or Path(f"{log.stem}-maps")
    # bounds that depend on several options are checked here, not by click
    with reraise_as(click.UsageError):
        how = Fusing(**options)
    if not explain:
        check_free(target)  # before the log is read, which takes minutes
    recording = read_log(log, columns=columns, posed=not align, **log_reading)
    if align:
        from scenegen.logs.align import align as aligned

        with ProgressBar("align", visible=verbose) as progress:
            progress.start(len(recording.poses))
            recording = aligned(recording, how, on_done=progress.count)
    if explain:
        row = recording.explained()
        if report_result(row):
            show_table(row)
    elif verbose:
        info(recording.line())
    # after --explain has printed why times are not known
    if how.deskew:
        recording.check_point_times()
    if explain:
        return
    with ProgressBar("ingest", visible=verbose) as progress:
        progress.start(len(recording.poses))
        counts = write(recording, target, how, on_done=progress.count)
    if report_result({"folder": str(target), "read": dict(recording.about), **counts}):
        source, folder = quote(str(target)), quote(f"{target}-samples")
        show_table(plain(counts) | {"next": f"scenegen generate --scene {source} -o {folder}"})
