"""Python files run one after another as a user runs them, each in a copy of one process.

A process that imports MuJoCo, numba and HDF5 takes a second for it. Here one process imports them,
and forks a copy of itself for every file that is run. The copy has imported nothing of a user's and
no command line; it runs the file as the interpreter does, with the file's folder first in
`sys.path`. It ends with the interpreter's exit code, less the second in which the interpreter takes
apart what is imported.
"""

import atexit
import gc
import importlib
import json
import os
import runpy
import shutil
import subprocess
import sys
import tempfile
import traceback
from pathlib import Path
from typing import NamedTuple

COMMON = """
scenegen.cli.generate scenegen.cli.verify scenegen.cli.publish
scenegen.cli.convert scenegen.draw.draw scenegen.verification.folder
scenegen.cli.bench scenegen.model.bench.run
lidarsim.engines.mujoco h5py numba ompl.base ompl.geometric scipy.ndimage trimesh
"""
"""What is imported beforehand. A user's module is not among it, nor `scenegen.__main__`, nor
torch."""


class Ended(NamedTuple):
    """How a process ended, and what it printed."""

    code: int
    out: str
    err: str


class Shell:
    """Runs files and commands in any folder."""

    def __init__(self):
        words = [sys.executable, "-c", "from tests.shell import serve; serve()"]
        root = Path(__file__).parents[1]
        self._server = subprocess.Popen(
            words, cwd=root, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        script = shutil.which("scenegen", path=str(Path(sys.executable).parent))
        assert script, "install scenegen first: pip install -e ."
        self._script = script

    def python(self, file, *words, here):
        """How ``python file words`` ends in the folder `here`."""
        asked = json.dumps([str(here), str(here / file), *map(str, words)])
        print(asked, file=self._server.stdin, flush=True)
        return Ended(*json.loads(self._server.stdout.readline()))

    def scenegen(self, *words, here):
        """How the installed script ends in the folder `here`."""
        return self.python(self._script, *words, here=here)

    def done(self, *words, here):
        """What the installed script prints; it must end well."""
        ended = self.scenegen(*words, here=here)
        assert ended.code == 0, ended.err
        return ended.out

    def close(self):
        """End the process."""
        self._server.communicate()
        assert self._server.returncode == 0


def serve():
    """For every line on standard input, a folder, a file and its arguments, run the file in a copy
    of this process."""
    for name in COMMON.split():
        importlib.import_module(name)
    assert not {"scenegen.__main__", "torch"} & sys.modules.keys()
    root = str(Path.cwd())
    sys.path[:] = [path for path in sys.path[1:] if path not in ("", root)]
    gc.freeze()  # what is collected no more is copied no more
    for line in sys.stdin:
        with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
            copy = os.fork()
            if copy == 0:
                _become(*json.loads(line), streams=(out.fileno(), err.fileno()))
            code = os.waitstatus_to_exitcode(os.waitpid(copy, 0)[1])
            said = [stream.seek(0) or stream.read().decode() for stream in (out, err)]
        print(json.dumps([code, *said]), flush=True)
    os._exit(0)


def _become(here, file, *words, streams):
    """Run the file in this process, and end it."""
    nothing = os.open(os.devnull, os.O_RDONLY)
    for number, handle in enumerate((nothing, *streams)):
        os.dup2(handle, number)
    os.chdir(here)
    for name in [name for name in sys.modules if name.partition(".")[0] == "tests"]:
        del sys.modules[name]
    sys.argv[:], sys.path[:0] = [file, *words], [str(Path(file).parent)]
    code = 1
    try:
        runpy.run_path(file, run_name="__main__")
        code = 0
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        atexit._run_exitfuncs()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
