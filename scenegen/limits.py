"""How large things may be. What generates refuses beyond these limits, and so does everything that reads: whatever one
part of scenegen writes, every other part takes."""

from collections.abc import Mapping

MOST_VOXELS = 1 << 26
"""In a grid: a distance field of this size takes 256 MB."""
MOST_VIEWPOINTS = 10_000
"""Of one flight."""
MOST_VOXELS_IN_FLIGHT = 1 << 30
"""Of all maps of one flight: its samples are in memory together, some eight bytes a voxel."""
MOST_CANDIDATES = 100_000
"""Places along one flight at which a scan may be tried."""
MOST_DRAWS = 10_000
"""Of one world."""
MOST_FLIGHTS = 1000
"""Tried in one world."""
MOST_ITERATIONS = 10**6
"""Of one search for a flight: some ten seconds."""
MOST_SEARCHED = 10**9
"""Iterations over all draws of one world and all flights in each: some hours, after which there is none."""
MOST_SEED = 2**63 - 1
"""What every reader of JSON takes as a whole number."""
MOST_SAMPLES = 10**9
"""Of a split."""
MOST_WORKERS = 1024
"""Processes."""
MOST_SAMPLES_IN_SHARD = 10**5
"""A shard is made in memory: some eight gigabytes of maps of the default size."""
MOST_OBJECTS = 64
"""In a shard's HDF5, and attributes of it."""
MOST_BLOCKS, MOST_BLOCK_BYTES = 64, 1 << 16
"""Of an HDF5 object's header."""
MOST_HEAP_BYTES = 1 << 20
"""Of the heaps that hold names and texts in HDF5."""
MOST_SHARDS = 99_999
"""In a split: what five digits can number."""
MOST_MANIFEST_BYTES = 64 << 20
"""Of `dataset.json`; some 200,000 shards."""
MOST_RECIPE_BYTES = 64 << 10
"""Of a recipe's TOML file: every parameter takes two kilobytes, and the time to parse grows faster than the size."""

MOST_GEOMS = 50_000
"""In a world: MuJoCo takes five seconds over so many, and four times as long over twice as many."""
MOST_DRAWN_SOLIDS = 20_000
"""In a world that a recipe draws, of all sorts together: MuJoCo takes a second over so many, twice a world, and
`verify` gives a shard of a hundred worlds three minutes."""
MOST_DRAWN_M = 1e4
"""Lengths in a recipe, metres: MJCF's six digits then place solids to a decimetre, and whatever is stacked or scattered
stays within `lidarsim.limits.MOST_LENGTH_M`."""
LEAST_DRAWN_M = 1e-3
"""Steps and distances of flights, metres: how finely motions are checked."""
MOST_ELEMENTS = 200_000
"""In an MJCF document."""
MOST_DEPTH = 200
"""Levels of elements in an MJCF document, or of anything that nests in JSON and TOML."""
MOST_CELLS = 1 << 24
"""Of a height field, pixels of an image, or numbers of an MJCF attribute."""
MOST_BUILTIN = 300
"""A parameter of a mesh that MuJoCo makes by itself, such as its resolution: some 100,000 vertices then."""
MOST_DOCUMENT_BYTES = 16 << 20
"""Of an MJCF document."""
MOST_ASSET_BYTES = 64 << 20
"""Of one file that a world refers to."""
MOST_ARCHIVE_BYTES = 1 << 30
"""Of all members of a shard's archive, unpacked."""
MOST_MEMBERS = 65_000
"""Of a shard's archive."""

SCENE_SECONDS, SCENE_BYTES = 60.0, 4 << 30
"""What reading one MJCF file of a stranger's may take: time, and memory of the process that does it."""

MOST_ASKED: Mapping[str, int] = {
    **{"memory": 1 << 30, "njmax": 1 << 20, "nconmax": 1 << 20, "nstack": 1 << 27, "nkey": 1000},
    **{"nuserdata": 1 << 20, "nrow": MOST_CELLS, "ncol": MOST_CELLS, "width": MOST_CELLS, "height": MOST_CELLS},
    **{f"nuser_{what}": 100 for what in ("body", "jnt", "geom", "site", "cam", "tendon", "actuator", "sensor")},
}
"""MJCF attributes for which MuJoCo takes as much memory as they say, and the most that they may say."""

MOST_WIDTH = 128
"""Channels at a network's first level: it then has 77 million parameters, 308 MB."""
MOST_FEATURES = 1 << 27
"""Voxels of a network's map times its channels at the first level: completing one map takes a few GB."""
MOST_BATCH = 4096
"""Maps a step of training, or completed at once."""
MOST_WEIGHTS_BYTES = 1 << 30
"""Of a .safetensors or .onnx file; a training state of the widest network has 924 MB."""
MOST_EPOCHS = 10_000
"""Of a training run: their figures stand in the header of its state, some kilobyte each."""
MOST_LINE_BYTES = 4096
"""Of a text that lists points."""
MOST_HEADER_BYTES = 16 << 20
"""Of a .safetensors file's header, a run's settings, or a point cloud's header."""
MOST_SCAN_BYTES = 256 << 20
"""Of a file of points."""
MOST_POINTS = 20_000_000
"""Of a scan: 480 MB as float64."""
MOST_CHUNK_BYTES = 256 << 20
"""Of a predictions file, unpacked: a map of `MOST_VOXELS` in float32."""

GUARD_S = 60.0
"""How long a library may look at a stranger's file before it counts as hung, seconds, beside what its size explains."""
GUARD_BYTES = 4 << 30
"""Address space it may take meanwhile, beside what its size explains."""
