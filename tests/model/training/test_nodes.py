"""torchrun on two nodes, begun by a real Slurm and by a real Ray: the network that one node trains,
to the bit.

python -m pytest -m slow tests/model/training/test_nodes.py
    Slurm: Debian's slurm-wlm and munge, and to be root; Ray: the extra `ray`
"""

import os
import sys

import pytest

from tests.command_line import ROOT, process
from tests.model.training.runs import check_same, figures
from tests.scenegen.base import slurm_here
from tests.scenegen.base.slurm_here import free_port

pytestmark = pytest.mark.slow
TORCHRUN = (sys.executable, "-m", "torch.distributed.run")


@pytest.fixture
def words(folders):
    """A short run."""
    options = "--width 4 --epochs 2 --batch 4 --device cpu --precision float32 --quiet --out"
    return [str(ROOT / "cli.py"), "train", str(folders[0]), *options.split()]


@pytest.fixture
def alone(words, tmp_path):
    """The run by two processes of one node."""
    out = tmp_path / "alone"
    run(*TORCHRUN, "--standalone", "--nproc-per-node", 2, *words, out)
    assert len(figures(out)) == 2
    return out


def run(*words):
    more = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "PYTHONFAULTHANDLER": "1"}
    process(*words, env=os.environ | more, timeout=200)


@slurm_here.NEEDED
def test_two_nodes_of_slurm_train_what_one_does(alone, words, tmp_path):
    out = tmp_path / "slurm"
    meeting = f"--rdzv-backend c10d --rdzv-endpoint 127.0.0.1:{free_port()} --rdzv-id test"
    nodes = f"--nnodes 2 --nproc-per-node 1 {meeting}"
    launch = ["srun", "--nodes=2", "--ntasks-per-node=1", *TORCHRUN, *nodes.split()]
    (tmp_path / "cluster").mkdir()
    with slurm_here.slurm(tmp_path / "cluster", nodes=2):
        run(*launch, *words, out)
    check_same(alone, out)


def test_two_nodes_of_ray_train_what_one_does(alone, words, tmp_path):
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    cluster_utils = pytest.importorskip("ray.cluster_utils")
    head = {"num_cpus": 1, "include_dashboard": False}
    cluster = cluster_utils.Cluster(initialize_head=True, head_node_args=head)
    try:
        cluster.add_node(num_cpus=1)
        launch = f"{ROOT}/docs/torchrun_on_ray.py --address {cluster.address} --nodes 2 --"
        run(sys.executable, *launch.split(), *words, tmp_path / "ray")
    finally:
        cluster.shutdown()
    check_same(alone, tmp_path / "ray")
