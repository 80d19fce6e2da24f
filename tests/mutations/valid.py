"""The valid inputs, made once by the commands themselves: what is compiled and imported late is
warm from then on."""

import contextlib
import dataclasses
import io
import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim import GridSpec
from tests.command_line import beside, code_of
from tests.conftest import SMALL
from tests.mutations import datasets
from tests.mutations.case import words

EDGE = 16
"""Voxels along each edge of the map."""
RECIPE = {
    "kind": "pillar",
    **SMALL,
    "flight": SMALL["flight"] | {"viewpoints": 2},
    "grid": {"shape": [EDGE] * 3},
}
SCENE = beside(__file__, "scene.xml")
GENERATE = (
    "generate --recipe recipe.toml --n 4 --val 2 --test 2 --shard-samples 2 "
    "--workers 1 --quiet --out"
)
BENCH = "bench d --quick --workers 1 --quiet --method returns --predictions predictions.h5"
INGEST = "-o out --every 2 --rise 2 --reach 4 --quiet"
"""How logs are ingested."""


@dataclass(frozen=True)
class Valid:
    """Files that are as they should be, and what commands make of them."""

    folder: Path
    """Holds d (a dataset), c (a compact one), n.safetensors, n.onnx, predictions.h5, scans, maps, a
    plan, and logs: those of ROS where its messages can be written."""
    loaded: dict[str, dict[bool, str]]
    """Digests of d and of c, without and with the derived fields."""
    files: dict[str, dict[str, str]]
    scored: dict[str, Any]
    """What `bench --predictions` reports of predictions.h5."""

    def put(self, name, here):
        """A copy of the file or folder `name`, to damage."""
        source = self.folder / name
        copy = shutil.copytree if source.is_dir() else shutil.copyfile
        return Path(copy(source, here / name))


def make_valid(folder):
    """Make them in `folder`, an empty one, which becomes the current folder."""
    os.chdir(folder)
    (folder / "recipe.toml").write_text(to_toml(RECIPE))
    (folder / "scene.toml").write_text(beside(__file__, "scene.toml"))
    run(f"{GENERATE} d")
    run(f"{GENERATE} c --compact")
    (folder / "scene.xml").write_text(SCENE)
    of_one = "--n 1 --val 0 --test 0 --workers 1 --quiet"
    run(f"generate --scene scene.xml --recipe scene.toml {of_one} --out s")
    _write_networks(folder)
    _write_scans_and_maps(folder)
    _write_logs(folder)
    run("verify d --workers 1 --quiet")
    run("complete d --weights n.safetensors --quiet --device cpu")
    Path("predictions/test-00000.h5").rename("predictions.h5")
    for scan in Path().glob("scan.*"):
        run(f"complete {scan} --weights n.safetensors --quiet -o out.h5 --device cpu")
    run("complete scan.npy --weights n.onnx --quiet -o out.h5")
    run(BENCH)
    return Valid(
        folder=folder,
        loaded={
            name: {derived: datasets.digest_of(name, derived=derived) for derived in (False, True)}
            for name in "dc"
        },
        files={name: datasets.files_of(folder / name) for name in "dc"},
        scored=scores(folder / "bench"),
    )


def _write_scans_and_maps(folder):
    import trimesh

    from scenegen.worlds.clouds.write import write_points
    from tests.scenegen.worlds import test_octomap, test_plan

    rng = np.random.default_rng(0)
    points = rng.uniform(-1.5, 1.5, (60, 3))
    np.save("scan.npy", points)
    np.savetxt("scan.xyz", points, fmt="%.4f")
    trimesh.PointCloud(points).export("scan.ply", encoding="ascii")
    for suffix in (".pcd", ".bin", ".npz"):
        write_points(folder / f"scan{suffix}", points, None, {})
    states = rng.integers(0, 3, (6, 5, 4)).astype(np.uint8)
    for suffix in (".bt", ".ot"):
        Path(f"map{suffix}").write_bytes(test_octomap.written(states, (-3, -3, -2), suffix))
    test_plan.write(folder)


def _write_logs(folder):
    from importlib.util import find_spec

    from tests.scenegen.logs.test_logs import write_livox, written

    times = {"t": np.linspace(0, 0.1, 40)}
    scans = [dataclasses.replace(scan, more=times) for scan in written(folder / "log.d", 3)]
    if find_spec("mcap_ros2"):
        written(folder / "log.mcap", 3)
        write_livox(folder / "log.livox.mcap", scans)
    for path in Path().glob("log.*"):
        run(f"ingest {path} {INGEST}")
        shutil.rmtree("out")


def run(line):
    """What a command prints in this process; it must succeed."""
    with contextlib.redirect_stdout(io.StringIO()) as said:
        assert code_of(*words(line)) == 0, line
    return said.getvalue()


def scores(folder):
    """What a report says of the row of ``predictions.h5``."""
    report = json.loads((folder / "report.json").read_text())
    return {
        table: report[table]["pillar"]["predictions"] for table in ("reconstruction", "planning")
    }


def to_toml(tables):
    """A recipe as TOML; what TOML cannot say stands there as JSON says it."""
    return "".join(f"{line}\n" for line in _lines(tables))


def _lines(table):
    return [f"{json.dumps(key)} = {_value(value)}" for key, value in table.items()]


def _value(value):
    if isinstance(value, float):
        return repr(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(_lines(value))}}}"
    return json.dumps(value).replace("\\ud800", "\ufffd")


def _write_networks(folder):
    import torch

    from tests.model.conftest import saved_network
    from tests.mutations.onnx_files import write_onnx

    torch.set_num_threads(1)
    saved_network(folder / "n.safetensors", GridSpec(shape=(EDGE, EDGE, EDGE)), width=1)
    write_onnx(folder / "n.onnx")
