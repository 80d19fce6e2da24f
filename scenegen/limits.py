"""How large things may be. What generates refuses beyond these limits, and so does everything that reads: whatever one
part of scenegen writes, every other part takes."""

from collections.abc import Mapping

MOST_VOXELS = 1 << 26
"""In a grid: a distance field of this size takes 256 MB."""
MOST_VIEWPOINTS = 10_000
"""Of one flight."""
MOST_SAMPLES_IN_SHARD = 10**7
MOST_SHARDS = 99_999
"""In a split: what five digits can number."""
MOST_MANIFEST_BYTES = 64 << 20
"""Of `dataset.json`; some 200,000 shards."""
MOST_RECIPE_BYTES = 1 << 20
"""Of a recipe's TOML file."""

MOST_GEOMS = 50_000
"""In a world: MuJoCo takes five seconds over so many, and four times as long over twice as many."""
MOST_DRAWN_SOLIDS = 20_000
"""In a world that a recipe draws: beyond this, next to no flight exists."""
MOST_ELEMENTS = 200_000
"""In an MJCF document."""
MOST_DEPTH = 200
"""Levels of elements in an MJCF document, or of anything that nests in JSON and TOML."""
MOST_CELLS = 1 << 24
"""Of a height field, pixels of an image, or numbers of an MJCF attribute."""
MOST_LENGTH_M = 1e6
"""Sizes and places in a world, metres: float64 then keeps a tenth of a nanometre."""
MOST_DOCUMENT_BYTES = 16 << 20
"""Of an MJCF document."""
MOST_ASSET_BYTES = 64 << 20
"""Of one file that a world refers to."""
MOST_ARCHIVE_BYTES = 1 << 30
"""Of all members of a shard's archive, unpacked."""
MOST_MEMBERS = 65_000
"""Of a shard's archive."""

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
