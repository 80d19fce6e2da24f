"""Size limits. Writers and readers share them, so that each part of scenegen accepts files of every
other part."""

from collections.abc import Mapping

MAX_VOXELS = 1 << 26
"""Maximum number of voxels of a grid. A float32 distance field of this size takes 256 MB."""
MAX_VIEWPOINTS = 10_000
"""Maximum number of viewpoints of a flight."""
MAX_VOXELS_IN_FLIGHT = 1 << 30
"""Maximum number of voxels of all maps of a flight. They are in memory together, with about eight
bytes a voxel."""
MAX_SCANS = 100
"""Maximum number of scans of a sample."""
MAX_RAYS_IN_SAMPLE = 4_000_000
"""Maximum number of rays of all scans of a sample."""
MAX_CANDIDATES = 100_000
"""Maximum number of positions along a flight at which a scan is tried."""
MAX_DRAWS = 10_000
"""Maximum number of draws of a world."""
MAX_FLIGHTS = 1000
"""Maximum number of flights tried in a world."""
MAX_ITERATIONS = 10**6
"""Maximum number of iterations of a path search: about ten seconds."""
MAX_SEARCHED = 10**9
"""Maximum number of iterations over all draws and flights of a world: some hours."""
MAX_SEED = 2**63 - 1
"""Largest seed: every JSON reader parses it as an integer."""
MAX_SAMPLES = 10**9
"""Maximum number of samples of a split."""
MAX_WORKERS = 100_000
"""Maximum number of worker processes, of all nodes together."""
MAX_WEIGHT = 10**9
"""Largest weight of a component of a stream."""
MAX_UNITS_IN_ROUND = 1000
"""Maximum number of flights in one round of a mixture."""
MAX_SOURCES = 1000
"""Maximum number of datasets of a collection."""
MAX_SAMPLES_IN_SHARD = 10**5
"""Maximum number of samples of a shard. A shard is made in memory: with default maps, this many
take about 8 GB."""
MAX_SHARDS = 200_000
"""Maximum number of shards of a dataset. Every command lists all of them in memory, about 5 kB
each."""
MAX_MANIFEST_BYTES = 128 << 20
"""Maximum size of `dataset.json`, bytes. With `MAX_SHARDS` shards it has about 80 MB."""
MAX_KIND_NAME = 100
"""Maximum length of a kind's name, characters."""
MAX_CLASSES = 10_000
"""Maximum number of classes of a labelled dataset."""
USUAL_IN_SHARD = 100
"""Default number of samples of a shard."""
MAX_RECIPE_BYTES = 64 << 10
"""Maximum size of a recipe's TOML file, bytes. Each parameter may take two kilobytes; parsing time
grows faster than the size."""

MAX_GEOMS = 50_000
"""Maximum number of geoms of a world. MuJoCo compiles these in five seconds, and takes four times
as long for twice as many."""
MAX_DRAWN_SOLIDS = 20_000
"""Maximum number of solids in a drawn world. MuJoCo compiles these in a second, twice a world, and
`verify` allows three minutes for a shard of a hundred worlds."""
MAX_DRAWN_M = 1e4
"""Largest length in a recipe, metres. With MJCF's six digits, solids are then placed to a
decimetre, and stacked or scattered ones stay within the largest length of a world."""
MIN_DRAWN_M = 1e-3
"""Smallest step or distance of a flight, metres: the resolution at which motions are checked."""
MAX_ELEMENTS = 200_000
"""Maximum number of elements of an MJCF document."""
MAX_OTHERS = 5000
"""Maximum number of elements other than geoms, meshes, height fields and materials. MuJoCo's
compile time is quadratic in the number of bodies, joints, sites and defaults."""
MAX_ATTRIBUTES = 100
"""Maximum number of attributes of an element. MuJoCo's parser compares each with all before it."""
MAX_DEPTH = 200
"""Maximum nesting depth of MJCF, JSON or TOML."""
MAX_CELLS = 1 << 24
"""Maximum number of cells of a height field, pixels of an image, or numbers in an MJCF attribute.
"""
MAX_BUILTIN = 300
"""Largest parameter of a built-in mesh of MuJoCo, such as its resolution: about 100,000 vertices.
"""
MAX_DOCUMENT_BYTES = 16 << 20
"""Maximum size of an MJCF document, bytes."""
MAX_ASSET_BYTES = 64 << 20
"""Maximum size of a file that a world refers to, bytes."""
MAX_PLACE_VOXELS = 1 << 28
"""Maximum number of voxels of a real place's map, a byte each: 290 × 170 × 30 m at 0.2 m take 180
MB."""
MAX_ARCHIVE_BYTES = 1 << 30
"""Maximum size of all unpacked members of a shard's archive, bytes."""
# more members than 65,535 need zip64, which readers of archives refuse
MAX_MEMBERS = 65_000
"""Maximum number of members of a shard's archive."""

SCENE_SECONDS, SCENE_BYTES = 60.0, 4 << 30
"""Time, seconds, and memory, bytes, of the process that reads an untrusted MJCF file."""

MAX_MJCF_VALUES: Mapping[str, int] = {
    "memory": 1 << 30,
    "nstack": 1 << 27,
    "nkey": 1000,
    **dict.fromkeys(("njmax", "nconmax", "nuserdata"), 1 << 20),
    **dict.fromkeys(("nrow", "ncol", "width", "height"), MAX_CELLS),
    **{
        f"nuser_{object_type}": 100
        for object_type in ("body", "jnt", "geom", "site", "cam", "tendon", "actuator", "sensor")
    },
}
"""Largest values of MJCF attributes by which a file can make MuJoCo allocate memory."""

MAX_WIDTH = 128
"""Maximum number of channels at a network's first level: 77 million parameters, 308 MB."""
MAX_FEATURES = 1 << 27
"""Maximum number of voxels of a map times channels of the network's first level. Completing one map
then takes a few GB."""
MAX_BATCH = 4096
"""Maximum number of maps in a training step, or completed at once."""
MAX_WEIGHTS_BYTES = 1 << 30
"""Maximum size of a .safetensors or .onnx file, bytes. A training state of the widest network has
924 MB."""
MAX_EPOCHS = 10_000
"""Maximum number of epochs of a training run. The header of its state holds about a kilobyte of
figures for each."""
MAX_MAPS = 10**10
"""Maximum number of maps that a training run sees: four months at one per millisecond."""
MAX_HEIGHT = 1024
"""Maximum height of a map for a network that sees whole columns, voxels."""
MAX_LINE_BYTES = 4096
"""Maximum length of a line in a text file of points, bytes."""
MAX_HEADER_BYTES = 16 << 20
"""Maximum size of a .safetensors header, a run's settings, or a point cloud's header, bytes."""
MAX_SCAN_BYTES = 256 << 20
"""Maximum size of a scan's file, bytes."""
MAX_CLOUD_BYTES = 1 << 30
"""Maximum size of a point file that becomes a map, bytes. A LAS file of `MAX_POINTS` has 400 to
800 MB."""
MAX_POINTS = 20_000_000
"""Maximum number of points of a scan: 480 MB as float64."""
MAX_CHUNK_BYTES = 256 << 20
"""Maximum size of an unpacked chunk of a predictions file, bytes: a map of `MAX_VOXELS` in
float32."""

GUARD_S = 60.0
"""Time for a library to read an untrusted file, seconds. The file's size adds to it."""
GUARD_BYTES = 4 << 30
"""Address space for it, bytes. The file's size adds to it."""

ROBOT_START_SECONDS, ROBOT_SECONDS, ROBOT_BYTES = 60.0, 1.0, 8 << 30
"""Time for an untrusted robot to start and to make a decision, seconds; and its address space,
bytes."""
MAX_ANSWER_BYTES = 4096
"""Maximum size of a robot's decision, bytes."""
