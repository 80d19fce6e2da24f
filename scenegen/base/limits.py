"""How large things may be. What generates refuses beyond these limits, and so does everything that
reads: whatever one part of scenegen writes, every other part takes.
"""

from collections.abc import Mapping

MOST_VOXELS = 1 << 26
"""The most voxels of a grid: a distance field of this size takes 256 MB."""
MOST_VIEWPOINTS = 10_000
"""The most viewpoints of one flight."""
MOST_VOXELS_IN_FLIGHT = 1 << 30
"""The most voxels in all maps of one flight together: they are in memory at once, with some eight
bytes a voxel."""
MOST_SCANS = 100
"""The most scans of one sample."""
MOST_RAYS_IN_SAMPLE = 4_000_000
"""The most rays in all scans of one sample together."""
MOST_CANDIDATES = 100_000
"""The most places along one flight at which a scan is tried."""
MOST_DRAWS = 10_000
"""The most draws of one world."""
MOST_FLIGHTS = 1000
"""The most flights tried in one world."""
MOST_ITERATIONS = 10**6
"""The most iterations of one search for a flight: they take some ten seconds."""
MOST_SEARCHED = 10**9
"""The most iterations over all draws of one world and all flights in each: they take some hours."""
MOST_SEED = 2**63 - 1
"""The largest seed: every reader of JSON takes it as a whole number."""
MOST_SAMPLES = 10**9
"""The most samples of a split."""
MOST_WORKERS = 100_000
"""The most worker processes, of all nodes together."""
MOST_WEIGHT = 10**9
"""The largest weight of a part of a stream."""
MOST_UNITS_IN_ROUND = 1000
"""The most flights after which a mixture's parts come round again."""
MOST_SOURCES = 1000
"""The most datasets whose samples are gathered in one."""
MOST_SAMPLES_IN_SHARD = 10**5
"""The most samples of a shard, which is made in memory: with default maps, these take some eight
gigabytes."""
MOST_SHARDS = 200_000
"""The most shards of a dataset: every command lists all in memory, with some 5 kilobytes each."""
MOST_MANIFEST_BYTES = 128 << 20
"""The most bytes of `dataset.json`: of `MOST_SHARDS`, it has some 80 MB."""
MOST_KIND_NAME = 100
"""The most characters of a kind's name."""
MOST_CLASSES = 10_000
"""The most classes of a dataset with labels."""
USUAL_IN_SHARD = 100
"""Samples in a shard, where nobody asks for another number."""
MOST_RECIPE_BYTES = 64 << 10
"""The most bytes of a recipe's TOML file. Every parameter may take two kilobytes; the time to parse
grows faster than the size."""

MOST_GEOMS = 50_000
"""The most geoms of a world: MuJoCo takes five seconds to compile these, and four times as long for
twice as many."""
MOST_DRAWN_SOLIDS = 20_000
"""The most solids, of all sorts together, in a world that a recipe draws. MuJoCo takes a second to
compile these, twice a world, and `verify` gives a shard of a hundred worlds three minutes."""
MOST_DRAWN_M = 1e4
"""The largest length in a recipe, metres: MJCF's six digits then place solids to a decimetre, and
what is stacked or scattered stays within a world's largest length."""
LEAST_DRAWN_M = 1e-3
"""The smallest step or distance of a flight, metres: motions are checked as finely as this."""
MOST_ELEMENTS = 200_000
"""The most elements of an MJCF document."""
MOST_OTHERS = 5000
"""The most of these that are no geoms, meshes, height fields or materials: MuJoCo's time to compile
bodies, joints, sites, defaults and their like grows as the square of their number."""
MOST_ATTRIBUTES = 100
"""The most attributes of one element; MuJoCo's parser holds each against all before it."""
MOST_DEPTH = 200
"""The most levels to which MJCF, JSON or TOML may nest."""
MOST_CELLS = 1 << 24
"""The most cells of a height field, pixels of an image, or numbers in an MJCF attribute."""
MOST_BUILTIN = 300
"""The largest parameter of a mesh that MuJoCo makes by itself, such as its resolution: some 100,000
vertices."""
MOST_DOCUMENT_BYTES = 16 << 20
"""The most bytes of an MJCF document."""
MOST_ASSET_BYTES = 64 << 20
"""The most bytes of one file that a world refers to."""
MOST_PLACE_VOXELS = 1 << 28
"""The most voxels of a real place's map: a byte each, and 290 × 170 × 30 m at 0.2 m take 180 MB."""
MOST_ARCHIVE_BYTES = 1 << 30
"""The most bytes of all members of a shard's archive together, unpacked."""
MOST_MEMBERS = 65_000
"""The most members of a shard's archive."""

SCENE_SECONDS, SCENE_BYTES = 60.0, 4 << 30
"""The time, seconds, and the memory that the process which reads a stranger's MJCF file may
take."""

MOST_ASKED: Mapping[str, int] = {
    "memory": 1 << 30,
    "nstack": 1 << 27,
    "nkey": 1000,
    **dict.fromkeys(("njmax", "nconmax", "nuserdata"), 1 << 20),
    **dict.fromkeys(("nrow", "ncol", "width", "height"), MOST_CELLS),
    **{
        f"nuser_{what}": 100
        for what in ("body", "jnt", "geom", "site", "cam", "tendon", "actuator", "sensor")
    },
}
"""MJCF attributes for which MuJoCo takes as much memory as they say, each with the largest value
that it may have."""

MOST_WIDTH = 128
"""The most channels at a network's first level: it then has 77 million parameters, 308 MB."""
MOST_FEATURES = 1 << 27
"""The most voxels of a network's map times its channels at the first level: completing one map then
takes a few GB."""
MOST_BATCH = 4096
"""The most maps in a step of training, or completed at once."""
MOST_WEIGHTS_BYTES = 1 << 30
"""The most bytes of a .safetensors or .onnx file; a training state of the widest network has 924
MB."""
MOST_EPOCHS = 10_000
"""The most epochs of a training run: the header of its state holds some kilobyte of figures for
each."""
MOST_MAPS = 10**10
"""The most maps that a training run sees: four months at one a millisecond."""
MOST_HEIGHT = 1024
"""The most voxels of a column that a network sees whole."""
MOST_LINE_BYTES = 4096
"""The most bytes of a line in a text file that lists points."""
MOST_HEADER_BYTES = 16 << 20
"""The most bytes of a .safetensors file's header, a run's settings, or a point cloud's header."""
MOST_SCAN_BYTES = 256 << 20
"""The most bytes of a scan's file."""
MOST_CLOUD_BYTES = 1 << 30
"""The most bytes of a file of points that becomes a map: a LAS file of `MOST_POINTS` has 400 to 800
MB."""
MOST_POINTS = 20_000_000
"""The most points of a scan: they take 480 MB as float64."""
MOST_CHUNK_BYTES = 256 << 20
"""The most bytes of a chunk of a predictions file, unpacked: a map of `MOST_VOXELS` in float32."""

GUARD_S = 60.0
"""How long a library may read a stranger's file before it counts as hung, seconds; the file's size
adds to it."""
GUARD_BYTES = 4 << 30
"""How much address space the library may take meanwhile; the file's size adds to it."""

ROBOT_START_SECONDS, ROBOT_SECONDS, ROBOT_BYTES = 60.0, 1.0, 8 << 30
"""The time that a stranger's robot may take to begin, and for a decision, seconds; and its address
space."""
MOST_ANSWER_BYTES = 4096
"""The most bytes of a robot's decision."""
