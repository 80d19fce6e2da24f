"""Sensors that people have, by name: figures of their makers' public documents and files.

What a document says of accuracy, typical or 1 sigma, is the standard deviation of `noise`. Where
that has `faint`, its figure is the range at which the document has a target of 10 % reflectivity
found.

Angles of single beams are nominal, or, of Ouster's, those of one unit; `error` says how far others
are from them. A unit's own go into `elevations_deg` and `azimuth_offsets_deg`. All rays begin in
one point: where a sensor's beams do not, `error` says so.
"""

import tomllib
from dataclasses import replace
from pathlib import Path

from lidarsim.sensors.nonrepetitive import Coil, Rosette
from lidarsim.sensors.raster import Pinhole
from lidarsim.sensors.spinning import Spinning

BEAMS = tomllib.loads(Path(__file__).with_name("beams.toml").read_text(encoding="utf-8"))
"""Beams that follow no rule, by model; the file says where they are from."""


def _even(low: float, high: float, count: int) -> tuple[float, ...]:
    """`count` angles from `low` to `high`, evenly spaced."""
    return tuple(round(low + (high - low) * n / (count - 1), 6) for n in range(count))


def _times(count: int, gap_s: float, begin_s: float = 0.0) -> tuple[float, ...]:
    return tuple(round(begin_s + n * gap_s, 12) for n in range(count))


VLP_16 = Spinning(
    name="velodyne-vlp-16",
    source="Velodyne VLP-16 User Manual, 63-9243 Rev. E: specifications, firing sequence, laser "
    "angles",
    checked="Lidar Toolbox of MathWorks, MRPT: 2°, 100 m, steps of 2 mm, 2.304 and 55.296 µs; "
    "ros-drivers/velodyne, VLP16db.yaml: the same angles",
    error="Lasers stand up to 11 mm above or below the centre, by the manual; here rays begin in "
    "it",
    # 16 lasers 2° apart, fired 2.304 µs apart from below and from the middle in turn, then a pause
    elevations_deg=tuple(float(angle) for low in range(-15, 0, 2) for angle in (low, low + 16)),
    firing_times_s=_times(16, 2.304e-6),
    firing_cycle_s=55.296e-6,
    max_range_m=100.0,
    noise="range:0.03,quantise:0.002",  # ± 3 cm typical, steps of 2 mm
)
HDL_32E = Spinning(
    name="velodyne-hdl-32e",
    source="Velodyne HDL-32E User Manual, 63-9113: specifications, firing sequence, laser angles",
    checked="The manual's pages on manualsonline, MRPT: 41.3°, 1 to 100 m, steps of 2 mm, 1.152 "
    "and 46.08 µs; ros-drivers/velodyne, 32db.yaml: every angle",
    error="The driver's file, too, has nominal angles; how far units are from them is not known",
    # 32 lasers 4/3° apart from -30.67° to +10.67°, fired 1.152 µs apart, in turn from both halves
    elevations_deg=tuple(
        round(angle * 4 / 3 - 92 / 3, 4) for low in range(16) for angle in (low, low + 16)
    ),
    firing_times_s=_times(32, 1.152e-6),
    firing_cycle_s=46.08e-6,
    max_range_m=100.0,
    min_range_m=1.0,
    noise="near:1,range:0.02,quantise:0.002",  # ± 2 cm, 1 sigma at 25 m
)
HDL_64E = Spinning(
    name="velodyne-hdl-64e",
    source="Velodyne HDL-64E S2 and S3 data sheets and manual, 63-HDL64ES3: +2° to -8.33° by "
    "1/3°, -8.83° to -24.33° by 1/2°; 0.1728° a column at 10 Hz",
    checked="Baidu Apollo on LiDARs: 64 channels, 120 m, 2 cm. ros-drivers/velodyne: an S3 "
    "(64e_s3-xiesc.yaml) is 0.14° rms off and 0.32° at most, another (64e_utexas.yaml) 0.22° and "
    "0.45°. The time of a cycle was not found again",
    error="Needs its unit's file: elevations are 0.14° to 0.22° rms off (an S2.1 by up to 3°). "
    "Missing: azimuths of up to 10° beside the head, lasers up to 26 mm beside and 7 cm above one "
    "another, the order of firing",
    elevations_deg=tuple(round(2 - n / 3, 4) for n in range(32))
    + tuple(round(-8.83 - n / 2, 4) for n in range(32)),
    firing_cycle_s=48e-6,  # 0.1728° at 10 Hz; the order of the lasers within a cycle is left out
    max_range_m=120.0,
    min_range_m=0.9,
    noise="near:0.9,range:0.02,quantise:0.002",  # < 2 cm, 1 sigma
)


def _ouster(
    model: str,
    unit: str,
    reach_m: tuple[float, float, float],
    sigma_m: tuple[float, float],
    checked: str,
    error: str,
) -> tuple[Spinning, ...]:
    """Ouster's of 32, 64 and 128 beams, all of a column at once.

    `unit` is the file whose angles they have; `reach_m` the least range, the range at 10 %
    reflectivity and the greatest range; `sigma_m` the best and the worst precision. The data sheet
    gives it for bands of ranges: here it grows evenly up to the greatest.
    """
    (least, faint, most), (best, worst) = reach_m, sigma_m
    precision = f"range:{best:g}:{(worst - best) / most:.2g}"
    return tuple(
        Spinning(
            name=f"ouster-{model.lower()}-{128 // step}",
            source=f"Ouster {model} data sheet, Rev 06: columns, range, precision of "
            f"{100 * best:g} "
            f"to {100 * worst:g} cm. Angles: a unit's metadata in ouster-sdk, tests/pcaps/"
            f"{unit}.json, beams {step}, {2 * step}, {3 * step} …",
            checked=checked,
            error=error,
            elevations_deg=BEAMS[model]["elevations_deg"][step - 1 :: step],
            azimuth_offsets_deg=BEAMS[model]["azimuth_offsets_deg"][step - 1 :: step],
            columns=1024,
            max_range_m=most,
            min_range_m=least,
            noise=f"near:{least:g},{precision},faint:{faint:g},quantise:0.001",
        )
        for step in (4, 2, 1)
    )


# How far units differ: at most, over the beams of those in ouster-sdk's tests.
# How far rays shift: a beam that begins n mm out, and points g beside that way, by 2 n sin(g / 2).
OS0_32, OS0_64, OS0_128 = _ouster(
    "OS0",
    unit="OS-0-128-U1_v2.3.0_1024x10",
    reach_m=(0.3, 15.0, 50.0),
    sigma_m=(0.015, 0.05),
    checked="MRPT mvsim: 1024 columns at 10 Hz; ouster-sdk's tests: angles of 5 more units of 128 "
    "beams and 2 of 32. Not found again: precision and ranges",
    error="Needs its unit's metadata: elevations differ by up to 1.0° from unit to unit, and by "
    "1.5° to a later revision. Beams begin 27.7 mm out from the axis; here on it, which shifts "
    "rays by up to 22 mm",
)
OS1_32, OS1_64, OS1_128 = _ouster(
    "OS1",
    unit="OS-1-128_v2.3.0_1024x10",
    reach_m=(0.3, 45.0, 120.0),
    sigma_m=(0.007, 0.05),
    checked="MRPT mvsim: 1024 columns at 10 Hz, 120 m; ouster-sdk's tests: angles of 4 more units "
    "of 128 beams, 1 of 64, 1 of 32. Least ranges and those at 10 % differ by revision: 0.3 to "
    "0.8 m, 40 to 90 m",
    error="Needs its unit's metadata: elevations differ by up to 1.0° from unit to unit. Beams "
    "begin 15.8 mm out from the axis; here on it, which shifts rays by up to 6 mm",
)
OS2_32, OS2_64, OS2_128 = _ouster(
    "OS2",
    unit="OS-2-128-U1_v2.3.0_1024x10",
    reach_m=(1.0, 80.0, 240.0),
    sigma_m=(0.025, 0.08),
    checked="MRPT mvsim: 1024 columns at 10 Hz; notes on Rev 7: 240 m; ouster-sdk's tests: angles "
    "of 2 more units of 128 beams and 1 of 32. Not found again: 80 m at 10 %",
    error="Needs its unit's metadata: elevations differ by up to 0.7° from unit to unit. Beams "
    "begin 13.8 mm out from the axis (27.4 in a later revision); here on it, which shifts rays by "
    "up to 3 mm",
)

XT_32 = Spinning(
    name="hesai-xt-32",
    source="Hesai PandarXT User Manual, X01-en: specifications, channel distribution; firing "
    "times of Tier IV's Nebula, pandar_xt32.hpp: 0.368 + 1.512 n µs",
    checked="NVIDIA Isaac ROS, AWSIM, hesaitech.com: -16°, 0.05 to 120 m, 80 m at 10 %, 0.18°; "
    "HesaiLidar_SDK_2.0, PandarXT-32 firing times: 6 + 1.512 n µs, which hold Nebula's 5.632 µs "
    "of a block. Early drivers have 0.28 for 0.368",
    error="A unit's file in Nebula, PandarXT32.csv, has elevations up to 0.08° off, and azimuths "
    "of up to 0.13°, here none",
    elevations_deg=_even(15.0, -16.0, 32),  # channel 1 is the highest
    firing_times_s=_times(32, 1.512e-6, 0.368e-6),
    columns=2000,  # 0.18° at 10 Hz
    max_range_m=120.0,
    min_range_m=0.05,
    noise="near:0.05,range:0.01,faint:80,quantise:0.004",  # ± 1 cm; 80 m at 10 %
)
QT_128 = Spinning(
    name="hesai-qt-128",
    source="Hesai QT128C2X User Manual, Q03-en-220810: specifications; HesaiLidar_SDK_2.0, "
    "correction/, QT128C2X: elevations, azimuths, firing times",
    checked="Tier IV's Nebula: the same 128 angles (PandarQT128.csv) and times "
    "(pandar_qt128.hpp); AWSIM: 111.11 µs, 20 m at 10 %, from 0.05 m",
    error="Channels 1 to 64 fire at every other column only, 0.8° apart; here all fire at every "
    "column. Angles are the maker's for all units: yours has a file of its own",
    elevations_deg=BEAMS["QT128"]["elevations_deg"],
    azimuth_offsets_deg=BEAMS["QT128"]["azimuth_offsets_deg"],
    firing_times_s=tuple(round(1e-6 * time, 9) for time in BEAMS["QT128"]["firing_times_us"]),
    columns=900,  # 0.4° at 10 Hz
    max_range_m=50.0,
    min_range_m=0.05,
    noise="near:0.05,range:0.03,faint:20,quantise:0.004",  # ± 3 cm; 20 m at 10 %
)
HELIOS_1615 = Spinning(
    name="robosense-helios-1615",
    source="RoboSense RS-Helios-1615 User Manual: specifications; rs_driver: times of firing",
    checked="rs_driver, decoder_RSHELIOS.hpp: 32 channels, 1.73 and 55.56 µs, steps of 2.5 mm; "
    "notes that quote the manual: -16° to 15°, 0.2 to 150 m, 2 cm; 90 m at 10 %, of which the "
    "maker's store says 110",
    error="A unit tells its own angles in its DIFOP packets; here they are 1° apart, which was "
    "not found again. Beams begin 35 mm out from the axis by rs_driver, here on it",
    elevations_deg=_even(15.0, -16.0, 32),
    firing_times_s=_times(32, 1.73e-6),
    columns=1800,  # 0.2° at 10 Hz, 55.56 µs
    max_range_m=150.0,
    min_range_m=0.2,
    noise="near:0.2,range:0.02,faint:90,quantise:0.0025",  # ± 2 cm; 90 m at 10 %
)
HELIOS_16P = replace(
    HELIOS_1615,
    name="robosense-helios-16p",
    source="RoboSense RS-Helios-16P User Manual: specifications, 2° apart",
    checked="rs_driver, decoder_RSHELIOS_16P.hpp, and a user's recording: 16 channels, 55.56 µs, "
    "steps of 2.5 mm; 90 m at 10 % as of the 1615",
    error="A unit tells its own angles in its DIFOP packets. Missing: firing times, up to 26 µs, "
    "which turn beams by 0.09°; beams begin 35 mm out from the axis by rs_driver, here on it",
    elevations_deg=_even(15.0, -15.0, 16),
    firing_times_s=(),
)
MID_360 = Coil(
    name="livox-mid-360",
    source="Livox Mid-360 User Manual v1.0, 2023.01: field of view, point rate, range; the "
    "pattern is ours",
    checked="Pages that quote livoxtech.com/mid-360/specs: -7° to 52°, 200,000 points a second, "
    "40 m at 10 % and 70 m at 80 %, 0.1 m, 2 cm at 10 m",
    error="Livox publishes no formula: the field of view and the rate hold, single curves do not",
    points_hz=200_000.0,
    lowest_deg=-7.0,
    highest_deg=52.0,
    max_range_m=70.0,
    min_range_m=0.1,
    noise="near:0.1,range:0.02,faint:40",  # ≤ 2 cm, 1 sigma at 10 m; 40 m at 10 %
)
AVIA = Rosette(
    name="livox-avia",
    source="Livox Avia User Manual v1.0, 2020.10: field of view, point rate, range; prisms as in "
    "Brazeal et al. 2021, Sensors 21, 4722, on the Mid-40",
    checked="A simulator and a project that quote Livox's page: 70.4° × 77.2°, 240,000 points a "
    "second, 190 m at 10 %, 450 m at 80 % in the dark, 2 cm at 20 m",
    error="Livox publishes no formula: prisms turn as the Mid-40's, and the six lines are one "
    "trace; single curves do not hold",
    horizontal_fov_deg=70.4,
    vertical_fov_deg=77.2,
    points_hz=240_000.0,
    max_range_m=450.0,
    min_range_m=1.0,
    noise="near:1,range:0.02,faint:190",  # 2 cm, 1 sigma at 20 m; 190 m at 10 %
)
D435 = Pinhole(
    name="realsense-d435",
    source="Intel RealSense D400 Series data sheet, 337029: field of view 87° × 58°, modes, least "
    "depth, 2 % at 2 m",
    checked="Threads of RealSense's staff (librealsense 7806), users' pages: 87° × 58° (one has "
    "86° × 57°), 2 % at 2 m, 10 m",
    error="Units differ by some 3° in the field of view. 0.28 m is the least depth of the largest "
    "mode; smaller ones, as here, see nearer. An ideal pinhole: no distortion, no shadow between "
    "the two imagers",
    width=424,
    height=240,
    horizontal_fov_deg=87.0,
    vertical_fov_deg=58.0,
    max_range_m=10.0,
    min_range_m=0.28,
    noise="near:0.28,depth:0.01",  # 2 % at 2 m, growing with the square: 1 % of the depth a metre
)
D455 = replace(
    D435,
    name="realsense-d455",
    source="Intel RealSense D400 Series data sheet, 337029: field of view 87° × 58°, modes, least "
    "depth, 2 % at 4 m",
    checked="Threads of RealSense's staff (librealsense 6697, 7806, 9241): 86° or 87° × 58°, 2 % "
    "at 4 m, best up to 6 m; nothing below 0.5 m at 1280 × 720, 0.34 m at 848 × 480",
    error="Units differ by some 3° in the field of view, and smaller modes, as here, see nearer. "
    "An ideal pinhole: no distortion, no shadow between the two imagers",
    max_range_m=20.0,
    min_range_m=0.52,
    noise="near:0.52,depth:0.005",
)
