"""The batch script of docs/cluster.md, on a real Slurm that is begun on this machine.

python -m pytest -m slow tests/scenegen/base/test_slurm.py
    needs Debian's slurm-wlm and munge, and to be root: it begins munged, slurmctld and slurmd
"""

import os
import re
import sys
import tempfile
from pathlib import Path

import pytest

from tests.command_line import ROOT, process
from tests.conftest import contents
from tests.scenegen.base import slurm_here

pytestmark = [pytest.mark.slow, slurm_here.NEEDED]
RUN = "generate --kind pillar --n 40 --shard-samples 10 --quiet --out"


def batch_script(text):
    """The indented lines of the page's first batch script."""
    (script,) = re.findall(r"^(?:    #!/bin/bash\n)(?:    .*\n)+", text, re.M)
    return re.sub(r"^    ", "", script, flags=re.M)


def test_a_job_array_makes_the_same_dataset(tmp_path):
    page = (ROOT / "docs" / "cluster.md").read_text()
    command = f"{sys.executable} -m scenegen"
    script = re.sub(
        r"^scenegen .*", f"{command} {RUN} there --on rank", batch_script(page), flags=re.M
    )
    script = script.replace("--array=0-63", "--array=0-1")
    (tmp_path / "job.sh").write_text(script)
    process(*command.split(), *RUN.split(), tmp_path / "here")
    # Slurm's sockets need a short path
    with tempfile.TemporaryDirectory() as short, slurm_here.slurm(Path(short), nodes=2):
        more = {"PYTHONPATH": str(ROOT)}
        process("sbatch", "--wait", "job.sh", cwd=tmp_path, env=os.environ | more, timeout=200)
    assert {path.name for path in tmp_path.glob("*.log")} == {"pillar-0.log", "pillar-1.log"}
    assert contents(tmp_path / "there") == contents(tmp_path / "here")
    assert Path(tmp_path / "there" / "dataset.json").exists()
