"""No command connects anywhere, and none leaves anything where nobody asked for it.

Commands run with a library before all others that notes every connection and every look-up of a
name, and refuses it. It sees what goes through the C library, as all of Python and every library
here does; not a system call made by hand.
"""

import importlib.util
import json
import os
import shutil
import sys

import pytest

from lidarsim.jit import cache_folder
from scenegen.__main__ import app
from tests.command_line import ROOT, SMALL, code_of, process, python
from tests.scenegen import cases

WORDS = [line.split() for (line,) in cases("../silence")]
"""Every command, in an order in which each finds what it needs."""
NAMES = {words[0] for words in WORDS}
DEAR = {"export"}
"""Commands that take ten seconds and more."""
ASKED = (
    "again bench c.safetensors d e.onnx f.json f.png i.html k log m.npz maps n.onnx o "
    "p p.png publish r.png run s.h5 s.ply scan.XYZ small.toml t taken.json v.html w.xml"
)
"""What commands are asked to leave where they run."""
FONTS = ".cache/matplotlib/"
"""Where matplotlib keeps its list of fonts, whoever imports it: all that may come to lie in a
user's home besides the kernels."""


@pytest.fixture(scope="session")
def shim(tmp_path_factory):
    """The library that notes connections, compiled."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("needs a C compiler called cc")
    folder = tmp_path_factory.mktemp("shim")
    for name in ("silence", "native"):
        made = f"{folder}/{name}.so {ROOT}/tests/{name}.c"
        process(*f"{compiler} -shared -fPIC -w -o {made} -ldl".split())
    return folder / "silence.so"


def environment(shim, folder):
    """Of a user whose home is empty, under the shim; the compiled kernels are where they always
    are."""
    names = {"PATH", "LD_LIBRARY_PATH", "VIRTUAL_ENV", "OMP_NUM_THREADS"} & os.environ.keys()
    kept = {name: os.environ[name] for name in names}
    for name in ("home", "temporary", "here"):
        (folder / name).mkdir(exist_ok=True)
    return kept | {
        "HOME": str(folder / "home"),
        "TMPDIR": str(folder / "temporary"),
        "SCENEGEN_CACHE": str(cache_folder("scenegen").parents[2]),
        "PYTHONPATH": str(ROOT),
        "LD_PRELOAD": str(shim),
        "SILENCE_LOG": str(folder / "log"),
    }


def noted(folder):
    """What the shim saw."""
    log = folder / "log"
    return log.read_text().splitlines() if log.exists() else []


REACH = """
import ctypes, socket, sys
ctypes.CDLL(sys.argv[1]).look_up()
for act in (lambda: socket.create_connection(('127.0.0.1', 9)),
            lambda: socket.gethostbyname('python.invalid'),
            lambda: socket.socket().connect(('127.0.0.1', 9)),
            lambda: socket.socket(type=socket.SOCK_DGRAM).sendto(b'', ('127.0.0.1', 9))):
    try:
        act()
    except OSError:
        pass
one, other = socket.socketpair()
one.sendall(b'near')
assert other.recv(4) == b'near'
"""


def test_the_shim_sees_python_and_native_libraries(shim, tmp_path):
    python("-c", REACH, shim.with_name("native.so"), env=environment(shim, tmp_path))
    seen = noted(tmp_path)
    names = ["native.invalid", "127.0.0.1", "python.invalid"]
    assert [line.split()[-1] for line in seen if line.split()[1:]] == names
    assert {"connect ", "sendto "} <= set(seen)
    assert len(seen) == 5


def lines_of(names):
    """The command lines of these commands, as far as what they need is installed."""
    runtime = any(importlib.util.find_spec(name) for name in ("openvino", "onnxruntime"))
    found = [words for words in WORDS if words[0] in names]
    return [words for words in found if runtime or "n.onnx" not in words]


def prepare(here):
    """What the commands read and do not make."""
    # the grid of n.onnx, and as many worlds as `calibrate` needs
    small = SMALL.replace("24, 24", "16, 16").replace("viewpoints = 3", "viewpoints = 2")
    (here / "small.toml").write_text(small)
    (here / "scan.XYZ").write_text(
        "".join(f"{x / 10} {y / 10} 0.3\n" for x in range(9) for y in range(9))
    )
    if importlib.util.find_spec("onnx"):
        from tests.mutations.onnx_files import write_onnx

        write_onnx(here / "n.onnx")


def everything_in(folder):
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if not path.is_dir()}


def check_silent(shim, folder, names):
    """Run these commands: nothing is noted, and nothing is left but what was asked for."""
    where = {"env": environment(shim, folder), "cwd": folder / "here"}
    prepare(folder / "here")
    python("-m", "tests.test_silence", input=json.dumps(lines_of(names)), **where)
    assert noted(folder) == []
    assert {path.name for path in (folder / "here").iterdir()} <= set(ASKED.split())
    assert everything_in(folder / "here" / "run") >= {"best.safetensors"}
    left = {name for name in everything_in(folder / "home") if not name.startswith(FONTS)}
    assert left == set()
    assert everything_in(folder / "temporary") == set()


def test_no_command_connects_or_leaves_anything_behind(shim, tmp_path):
    if not importlib.util.find_spec("torch"):
        pytest.skip("needs torch")
    assert set(app.registry.builtin) == NAMES, "a new command? say here how it is run"
    check_silent(shim, tmp_path, NAMES - DEAR)


@pytest.mark.slow
def test_nor_do_the_dear_ones(shim, tmp_path):
    if not importlib.util.find_spec("onnxscript"):
        pytest.skip("needs onnxscript")
    check_silent(shim, tmp_path, {"generate", "train"} | DEAR)


def main():
    """Run the command lines that standard input lists, one after another, in this process."""
    import time

    from scenegen.cli import doctor
    from scenegen.publish import stage
    from scenegen.view import stills

    doctor.SELF_TEST_S = 0.1  # which draws as many samples as it finds time for
    stage.SHOWN = 1
    stills.DPI = 50  # pictures have their own tests
    for words in json.load(sys.stdin):
        begin = time.process_time()
        assert code_of(*words) == 0, words
        print(f"{time.process_time() - begin:.1f} s for {' '.join(words)}", file=sys.stderr)


if __name__ == "__main__":
    main()
