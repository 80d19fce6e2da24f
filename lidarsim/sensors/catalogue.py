"""Sensors that people have, by name: figures of their makers' public documents, each named beside them.

Angles of single beams are the nominal ones: a unit's own calibration goes into `elevations_deg` and
`azimuth_offsets_deg`. What a document says of accuracy, typical or 1 sigma, is the standard deviation of `noise`. Where
that has `faint`, its figure is the range at which the document has a target of 10 % reflectivity found.
"""

from lidarsim.sensors.device import Device
from lidarsim.sensors.nonrepetitive import Coil, Rosette
from lidarsim.sensors.pinhole import Pinhole
from lidarsim.sensors.spinning import Spinning


def _even(low: float, high: float, count: int) -> tuple[float, ...]:
    """`count` angles from `low` to `high`, evenly spaced."""
    return tuple(round(low + (high - low) * n / (count - 1), 6) for n in range(count))


def _times(count: int, gap_s: float, begin_s: float = 0.0) -> tuple[float, ...]:
    return tuple(round(begin_s + n * gap_s, 12) for n in range(count))


VLP_16 = Spinning(
    name="velodyne-vlp-16",
    source="Velodyne VLP-16 User Manual, 63-9243 Rev. E: specifications, firing sequence, laser angles",
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
    # 32 lasers 4/3° apart from -30.67° to +10.67°, fired 1.152 µs apart, in turn from both halves
    elevations_deg=tuple(round(angle * 4 / 3 - 92 / 3, 4) for low in range(16) for angle in (low, low + 16)),
    firing_times_s=_times(32, 1.152e-6),
    firing_cycle_s=46.08e-6,
    max_range_m=100.0,
    min_range_m=1.0,
    noise="near:1,range:0.02,quantise:0.002",  # ± 2 cm, 1 sigma at 25 m
)
HDL_64E = Spinning(
    name="velodyne-hdl-64e",
    source="Velodyne HDL-64E S2 and S3 data sheets and manual, 63-HDL64ES3: +2° to -8.33° by 1/3°, -8.83° to -24.33° "
    "by 1/2°; 0.1728° a column at 10 Hz",
    elevations_deg=tuple(round(2 - n / 3, 4) for n in range(32)) + tuple(round(-8.83 - n / 2, 4) for n in range(32)),
    firing_cycle_s=48e-6,  # 0.1728° at 10 Hz; the order of the lasers within a cycle is left out
    max_range_m=120.0,
    min_range_m=0.9,
    noise="near:0.9,range:0.02,quantise:0.002",  # < 2 cm, 1 sigma
)

_OUSTER = "Ouster {} data sheet, Rev 06: vertical field of view, beams, columns, range, precision"


def _ouster(
    model: str, beams: int, half_fov_deg: float, reach_m: tuple[float, float, float], sigma_m: float
) -> Spinning:
    """One of Ouster's: beams evenly spaced, all of a column at once. `reach_m` is the least range, the range at 10 %
    reflectivity and the greatest range."""
    least, faint, most = reach_m
    return Spinning(
        name=f"ouster-{model.lower()}-{beams}",
        source=_OUSTER.format(model),
        elevations_deg=_even(half_fov_deg, -half_fov_deg, beams),
        columns=1024,
        max_range_m=most,
        min_range_m=least,
        noise=f"near:{least:g},range:{sigma_m:g},faint:{faint:g},quantise:0.001",
    )


OS0_32, OS0_64, OS0_128 = (_ouster("OS0", beams, 45.0, (0.3, 15.0, 50.0), 0.015) for beams in (32, 64, 128))
OS1_32, OS1_64, OS1_128 = (_ouster("OS1", beams, 22.5, (0.3, 45.0, 120.0), 0.007) for beams in (32, 64, 128))
OS2_32, OS2_64, OS2_128 = (_ouster("OS2", beams, 11.25, (1.0, 80.0, 240.0), 0.025) for beams in (32, 64, 128))

XT_32 = Spinning(
    name="hesai-xt-32",
    source="Hesai PandarXT User Manual, X01-en: specifications, channel distribution, firing time of each channel",
    elevations_deg=_even(15.0, -16.0, 32),  # channel 1 is the highest
    firing_times_s=_times(32, 1.512e-6, 0.28e-6),
    columns=2000,  # 0.18° at 10 Hz
    max_range_m=120.0,
    min_range_m=0.05,
    noise="near:0.05,range:0.01,faint:80,quantise:0.004",  # ± 1 cm; 80 m at 10 %
)
QT_128 = Spinning(
    name="hesai-qt-128",
    source="Hesai QT128C2X User Manual, Q03-en-220810: specifications; its channels are spaced evenly here, and fire "
    "at every column, where half of them skip every other one",
    elevations_deg=_even(52.6, -52.6, 128),
    columns=900,  # 0.4° at 10 Hz
    max_range_m=50.0,
    min_range_m=0.05,
    noise="near:0.05,range:0.03,faint:20,quantise:0.004",  # ± 3 cm; 20 m at 10 %
)
HELIOS_1615 = Spinning(
    name="robosense-helios-1615",
    source="RoboSense RS-Helios-1615 User Manual: specifications; its channels are spaced evenly here; times of firing "
    "as in the maker's driver, rs_driver",
    elevations_deg=_even(15.0, -16.0, 32),
    firing_times_s=_times(32, 1.73e-6),
    columns=1800,  # 0.2° at 10 Hz, 55.56 µs
    max_range_m=150.0,
    min_range_m=0.2,
    noise="near:0.2,range:0.02,faint:90,quantise:0.0025",  # ± 2 cm; 90 m at 10 %, of which the maker's store says 110
)
HELIOS_16P = Spinning(
    name="robosense-helios-16p",
    source="RoboSense RS-Helios-16P User Manual: specifications, 2° apart",
    elevations_deg=_even(15.0, -15.0, 16),
    columns=1800,
    max_range_m=150.0,
    min_range_m=0.2,
    noise="near:0.2,range:0.02,faint:90,quantise:0.0025",
)
MID_360 = Coil(
    name="livox-mid-360",
    source="Livox Mid-360 User Manual v1.0, 2023.01: field of view, point rate, range; the pattern is ours",
    points_hz=200_000.0,
    lowest_deg=-7.0,
    highest_deg=52.0,
    max_range_m=70.0,
    min_range_m=0.1,
    noise="near:0.1,range:0.02,faint:40",  # ≤ 2 cm, 1 sigma at 10 m; 40 m at 10 %
)
AVIA = Rosette(
    name="livox-avia",
    source="Livox Avia User Manual v1.0, 2020.10: field of view, point rate, range; prisms as in Brazeal et al. 2021, "
    "Sensors 21, 4722, on the Mid-40; its lines are one trace here",
    horizontal_fov_deg=70.4,
    vertical_fov_deg=77.2,
    points_hz=240_000.0,
    max_range_m=450.0,
    min_range_m=1.0,
    noise="near:1,range:0.02,faint:190",  # 2 cm, 1 sigma at 20 m; 190 m at 10 %
)
D435 = Pinhole(
    name="realsense-d435",
    source="Intel RealSense D400 Series data sheet, 337029: field of view 87° × 58°, modes, least depth, 2 % at 2 m",
    width=424,
    height=240,
    horizontal_fov_deg=87.0,
    vertical_fov_deg=58.0,
    max_range_m=10.0,
    min_range_m=0.28,
    noise="near:0.28,depth:0.01",  # 2 % at 2 m, growing with the square: 1 % of the depth a metre
)
D455 = Pinhole(
    name="realsense-d455",
    source="Intel RealSense D400 Series data sheet, 337029: field of view 87° × 58°, modes, least depth, 2 % at 4 m",
    width=424,
    height=240,
    horizontal_fov_deg=87.0,
    vertical_fov_deg=58.0,
    max_range_m=20.0,
    min_range_m=0.52,
    noise="near:0.52,depth:0.005",
)

NAMED: dict[str, Device] = {
    sensor.name: sensor
    for sensor in (
        *(VLP_16, HDL_32E, HDL_64E, OS0_32, OS0_64, OS0_128, OS1_32, OS1_64, OS1_128, OS2_32, OS2_64, OS2_128),
        *(XT_32, QT_128, HELIOS_1615, HELIOS_16P, MID_360, AVIA, D435, D455),
    )
}
"""Every sensor of the catalogue but the paper's, which is the raster."""
