"""torchrun on several nodes of a Ray cluster, one torchrun a node:

python docs/torchrun_on_ray.py --nodes 2 --processes 4 --gpus 4 -- $(which scenegen) train
data/pillar --batch 64

Words after -- are torchrun's, the program first. They run in this folder, which every node needs by
the same path. Ends with 1 where a node's torchrun does. Ctrl-C ends all of them.
"""

import argparse
import os
import socket
import subprocess
import sys
from pathlib import Path

os.environ["RAY_USAGE_STATS_ENABLED"] = "0"  # nothing is reported; before Ray is imported
import ray
from ray.util.placement_group import placement_group
from ray.util.scheduling_strategies import PlacementGroupSchedulingStrategy


def meeting_place() -> tuple[str, int]:
    """Where the processes meet: an address of this node, and a port that is free there."""
    with socket.socket() as found:
        found.bind(("", 0))
        return ray.util.get_node_ip_address(), found.getsockname()[1]


def launch(options: list[str], words: list[str], folder: Path) -> int:
    """Run torchrun on this node, to its end; its exit code."""
    command = [sys.executable, "-m", "torch.distributed.run", *options, *words]
    with subprocess.Popen(command, cwd=folder) as running:
        try:
            return running.wait()
        except BaseException:  # the task is cancelled
            running.terminate()  # which ends the processes that it began
            raise


def main() -> int:
    """Begin them all, and wait."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--address", default="auto", help="HOST:PORT of the cluster's head; auto for this machine's"
    )
    parser.add_argument("--nodes", type=int, default=2)
    parser.add_argument("--processes", type=int, default=1, help="on every node")
    parser.add_argument("--gpus", type=int, default=0, help="of every node")
    parser.add_argument("words", nargs="+")
    given = parser.parse_args()
    ray.init(address=given.address, logging_level="ERROR")
    group = placement_group(
        [{"CPU": given.processes, "GPU": given.gpus}] * given.nodes, strategy="STRICT_SPREAD"
    )

    def on(node: int) -> dict[str, object]:
        strategy = PlacementGroupSchedulingStrategy(group, placement_group_bundle_index=node)
        needs = {"num_cpus": given.processes, "num_gpus": given.gpus, "max_retries": 0}
        return {"scheduling_strategy": strategy, **needs}

    host, port = ray.get(ray.remote(meeting_place).options(**on(0)).remote())
    common = ["--nnodes", str(given.nodes), "--nproc-per-node", str(given.processes)]
    common += ["--master-addr", host, "--master-port", str(port)]
    running = [
        ray.remote(launch)
        .options(**on(node))
        .remote([*common, "--node-rank", str(node)], given.words, Path.cwd())
        for node in range(given.nodes)
    ]
    try:
        return int(any(ray.get(running)))
    except KeyboardInterrupt:
        for task in running:
            ray.cancel(task)
        ray.wait(running, num_returns=len(running), timeout=60)
        return 130


if __name__ == "__main__":
    sys.exit(main())
