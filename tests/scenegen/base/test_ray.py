"""On a real Ray cluster: the same bits, also where a node is killed on the way.

python -m pytest -m slow tests/scenegen/base/test_ray.py        needs the extra `ray`
"""

import os
import signal
import subprocess
import sys
import time

import pytest

from scenegen.base.errors import GenerationError
from scenegen.base.executors import executor
from scenegen.dataset.build import build
from tests.command_line import ROOT, python
from tests.conftest import contents
from tests.scenegen.base.test_executors import plan
from tests.scenegen.conftest import wait_for

ray = pytest.importorskip("ray")
cluster_utils = pytest.importorskip("ray.cluster_utils")
pytestmark = pytest.mark.slow


@pytest.fixture
def cluster():
    """A head and two nodes of one core each, all on this machine, to which this process is
    connected."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    found = cluster_utils.Cluster(
        initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False}
    )
    found.nodes = [found.add_node(num_cpus=1) for _ in range(2)]
    ray.init(address=found.address, log_to_driver=False, configure_logging=False)
    yield found
    ray.shutdown()
    found.shutdown()


def test_a_cluster_makes_the_same_dataset_though_a_node_dies(cluster, tmp_path):
    build(plan(tmp_path / "here"))
    killed = []

    def kill_one(report, fresh):
        if fresh and not killed:
            killed.append(cluster.nodes.pop())
            cluster.remove_node(killed[0], allow_graceful=False)

    build(plan(tmp_path / "there"), execute=executor("ray", 1), on_shard=kill_one)
    assert killed
    assert contents(tmp_path / "there") == contents(tmp_path / "here")
    assert ray.is_initialized()  # what was there before is left


BEAT = """
import sys
from pathlib import Path
from scenegen.cli import stops
from scenegen.base.executors import executor
from tests.scenegen.base.test_ray import beat
stops.answer()
list(executor("ray://auto", 1)(beat, [Path(sys.argv[1])], lambda: None))
"""


def beat(path):
    """Write for a minute what time it is."""
    for _ in range(300):
        path.write_text(str(time.time()))
        time.sleep(0.2)


def test_a_stop_ends_the_tasks_of_this_run_and_no_others(cluster, tmp_path):
    ours, others = tmp_path / "ours", tmp_path / "others"
    task = ray.remote(beat).remote(others)
    environment = os.environ | {"RAY_ADDRESS": cluster.address, "PYTHONPATH": str(ROOT)}
    words = [sys.executable, "-c", BEAT, str(ours)]
    with subprocess.Popen(words, env=environment) as running:
        wait_for(lambda: ours.exists() and others.exists())
        running.send_signal(signal.SIGINT)
        assert running.wait(20) == 130
    time.sleep(10)
    now = time.time()
    assert float(ours.read_text()) < now - 5
    assert float(others.read_text()) > now - 2
    ray.cancel(task, force=True)


def test_usage_is_never_reported():
    """The switch is off before Ray is imported, and Ray's own opinion is asked."""
    code = (
        "from scenegen.base.executors import executor\nexecutor('ray', 1)\n"
        "from ray._common.usage import "
        "usage_lib\nassert not usage_lib.usage_stats_enabled()\n"
    )
    clean = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    python("-c", code, env=clean, timeout=120)


def test_an_address_where_nobody_answers_ends_in_one_line():
    pytest.importorskip("grpc", reason="Ray's client needs grpcio")
    with pytest.raises(GenerationError) as caught:
        list(executor("ray://127.0.0.1:9", 1)(abs, [1], lambda: None))
    assert str(caught.value).startswith("--on ray://127.0.0.1:9: no cluster answers")
