"""Public scans of real sensors against the catalogue: what `scenegen sensors --against` measures,
and for which models of the catalogue it takes each scan.

    python benchmarks/real_sensors.py --nebula nebula --ouster ouster-sdk --kitti patchwork-plusplus

The folders are checkouts of `tier4/nebula` (decoded scans), `ouster-lidar/ouster-sdk` (recordings,
which need `pip install ouster-sdk`) and `url-kaist/patchwork-plusplus` (six scans of KITTI). A
simulated VLP-16 with noise of 12 mm in steps of 2 mm and 3 % of lost rays is measured, too.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import measuring
import numpy as np

from lidarsim import Pose
from lidarsim.noise.chain import Noise
from lidarsim.noise.ranges import Range
from lidarsim.sensors import CATALOGUE, SENSORS
from lidarsim.sensors.device import angles_deg
from lidarsim.sensors.spinning import Spinning
from scenegen.draw.draw import scan_world
from scenegen.draw.source import named_world
from scenegen.logs.against import SensorUnit, measure
from scenegen.worlds.clouds import Cloud, read_cloud

MODELS = [m for name in CATALOGUE if isinstance(m := SENSORS.find(name), Spinning)]
OWN = {"vlp16": "velodyne-vlp-16", "xt32": "hesai-xt-32", "qt128": "hesai-qt-128"}
"""Scans of Nebula whose sensors the catalogue has."""
RANGE_M = 5.0
"""At which noise is compared."""


class Options(measuring.Options):
    """Where the scans are."""

    nebula: Path | None = None
    ouster: Path | None = None
    kitti: Path | None = None


def main() -> None:
    """Print a line for each unit."""
    given = measuring.parse(Options)
    print(
        "scan | model | channels | off: median, worst, ° | azimuth step, ° | range step, mm | "
        f"ranges, m | noise at {RANGE_M:g} m, mm: unit, model | lost | taken for"
    )
    print("|".join(["---"] * 10))
    for name, model, clouds in scans(given):
        print(line(name, model, clouds), flush=True)


def scans(given: Options) -> Iterator[tuple[str, Spinning | None, list[Cloud]]]:
    """Name, model if the catalogue has it, and clouds of each unit."""
    yield "simulated", SENSORS.find("velodyne-vlp-16"), [simulated()]
    if given.nebula:
        for file in sorted(given.nebula.rglob("decoder_ground_truth/*/*.pcd")):
            name = OWN.get(file.parent.name)
            model = SENSORS.find(name) if name else None
            yield file.parent.name, model, [read_cloud(file)]
    if given.ouster:
        for file in sorted(given.ouster.glob("tests/pcaps/OS-*.pcap")):
            yield from recorded(file)
    if given.kitti:
        files = sorted(given.kitti.glob("data/*.bin"))
        hdl_64e = SENSORS.find("velodyne-hdl-64e")
        yield "KITTI", hdl_64e, [by_turns(read_cloud(file)) for file in files]


def simulated() -> Cloud:
    """A scan of the warehouse in `scenes/`."""
    world = named_world(str(Path(__file__).parents[1] / "scenes" / "warehouse.xml"), 0)
    pose, sensor = Pose.level((8.0, 6.0, 1.5)), SENSORS.find("velodyne-vlp-16")
    noise = "range:0.012,dropout:0.03,quantise:0.002"
    scan = scan_world(world, sensor, pose, Noise.parse(noise), seed=0)
    return Cloud(pose.to_body(scan.points(0)), "")


def by_turns(cloud: Cloud) -> Cloud:
    """A cloud of KITTI with the numbers of its channels: their points follow each other, from the
    front around."""
    around = angles_deg(cloud.points)[1] % 360
    return Cloud(cloud.points, cloud.layout, rings=np.cumsum(np.diff(around, prepend=0) < -180))


def recorded(file: Path) -> Iterator[tuple[str, Spinning | None, list[Cloud]]]:
    """A unit of Ouster, with the numbers of its channels; and again with a model that has the
    unit's own angles, which its metadata hold."""
    try:
        from ouster.sdk import core, open_source

        frames = [frame for (frame,) in open_source(str(file))]
    except Exception as error:  # no ouster-sdk; or its own, as for a recording without metadata
        print(f"not measured: {file.name}: {type(error).__name__}")
        return
    info = frames[0].sensor_info
    points = [core.XYZLut(info, use_extrinsics=False)(frame) for frame in frames]
    rings = np.indices(points[0].shape[:2])[0].ravel()
    clouds = [Cloud(part.reshape(-1, 3), "", rings=rings) for part in points]
    name = f"ouster-{info.prod_line.lower().replace('-', '')[:3]}-{len(points[0])}"
    model = SENSORS.find(name) if name in CATALOGUE else None
    yield file.stem, model, clouds
    if model:
        angles = tuple(info.beam_altitude_angles)
        yield f"{file.stem}, own angles", replace(model, elevations_deg=angles), clouds


def line(name: str, model: Spinning | None, clouds: list[Cloud]) -> str:
    """What is measured of a unit, and the models of the catalogue for which it is taken."""
    unit = unit_of(clouds, model) if model else None
    taken = [sensor.name for sensor in MODELS if unit_of(clouds, sensor)]
    cells = [name, model.name if model else "none", *(facts(unit) if unit else ["refused"])]
    return " | ".join([*cells, ", ".join(taken) or "none"])


def unit_of(clouds: list[Cloud], sensor: Spinning) -> SensorUnit | None:
    """The unit, or None if it is refused."""
    try:
        return measure(clouds, sensor)
    except ValueError:
        return None


def facts(unit: SensorUnit) -> list[str]:
    """What is measured."""
    said = unit.facts()
    noises = [
        next(
            f"{1e3 * stage.sigma(np.array(RANGE_M)):.1f}"
            for stage in noise.stages
            if isinstance(stage, Range)
        )
        for noise in (unit.noise, Noise.parse(unit.model.noise))
    ]
    return [
        f"{said['channels']} of {len(unit.model.elevations_deg)}",
        *(
            "{:.3f}, {:.3f}".format(*said[key])
            for key in ("elevations_off_deg", "azimuth_step_deg")
        ),
        f"{1e3 * unit.quantum_m:g}",
        "{:g}, {:g}".format(*said["range_m"]),
        ", ".join(noises),
        str(said["lost"]),
    ]


if __name__ == "__main__":
    main()
