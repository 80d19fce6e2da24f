"""torchrun on two nodes, begun by a real Ray: the network that one node trains, to the bit.

python -m pytest -m slow tests/model/training/test_nodes.py
    needs the extra `ray`
"""

import os
import subprocess
import sys

import pytest

from tests.command_line import ROOT
from tests.model.training.test_loop import figures, same

WORDS = "--width 4 --epochs 2 --batch 4 --device cpu --precision float32 --quiet --out"


def run(command):
    more = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "RAY_USAGE_STATS_ENABLED": "0"}
    ended = subprocess.run(
        command, env=os.environ | more, capture_output=True, text=True, check=False, timeout=200
    )
    assert ended.returncode == 0, f"{ended.stdout[-2000:]}\n{ended.stderr[-4000:]}"


@pytest.mark.slow
def test_two_nodes_of_ray_train_what_one_does(folders, tmp_path, monkeypatch):
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    cluster_utils = pytest.importorskip("ray.cluster_utils")
    words = [str(ROOT / "cli.py"), "train", str(folders[0]), *WORDS.split()]
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    run([*torchrun, "--nproc-per-node", "2", *words, str(tmp_path / "alone")])
    head = {"num_cpus": 1, "include_dashboard": False}
    cluster = cluster_utils.Cluster(initialize_head=True, head_node_args=head)
    try:
        cluster.add_node(num_cpus=1)
        launch = f"{ROOT}/docs/torchrun_on_ray.py --address {cluster.address} --nodes 2 --"
        run([sys.executable, *launch.split(), *words, str(tmp_path / "ray")])
    finally:
        cluster.shutdown()
    assert same(*(tmp_path / name / "best.safetensors" for name in ("alone", "ray")))
    assert figures(tmp_path / "ray") == figures(tmp_path / "alone")
