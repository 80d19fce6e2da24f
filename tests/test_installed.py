"""Installed, scenegen shows two packages, `scenegen` and `lidarsim`, and no user's file of any name
gets in its way."""

import sys
import tomllib
import venv
import zipfile

import pytest
from packaging.requirements import Requirement

import scenegen
from tests.command_line import ROOT, process

USERS = {
    "model.py": "mine = 'model'",
    "cli.py": "mine = 'cli'",
    "data.py": "mine = 'data'",
    "tests/helpers.py": "mine = 'tests.helpers'",
    "docs/notes.py": "mine = 'docs.notes'",
}
"""Files that a user has beside a script, under names that are common in the field."""
SCRIPT = """
import cli, data, docs.notes, model, tests.helpers
assert [cli.mine, data.mine, docs.notes.mine, model.mine, tests.helpers.mine]
from scenegen.model.completion.protocol import Extrude
import lidarsim, scenegen
print(Extrude.name, scenegen.__version__)
"""


def environment(folder):
    """The interpreter of a new environment that has this one's packages, but nothing of ours."""
    venv.create(folder, with_pip=False)
    (site,) = (folder / "lib").glob("python*/site-packages")
    ours = [path for path in sys.path if path.endswith("site-packages")]
    # a path from a .pth file: its own .pth files, among them that of our editable install, do not
    # count
    (site / "others.pth").write_text("".join(f"{path}\n" for path in ours))
    return folder / "bin" / "python"


@pytest.mark.slow
def test_the_wheel_works_in_an_empty_environment_beside_a_users_own_files(tmp_path):
    def run(*words):
        return process(*words, cwd=tmp_path).stdout

    pip = f"{sys.executable} -m pip"
    run(*f"{pip} wheel -q --no-deps -w {tmp_path}/dist {ROOT}".split())
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        top = {name.split("/")[0] for name in archive.namelist() if "dist-info" not in name}
        assert {
            "lidarsim/sensors/catalogue.toml",
            "scenegen/logs/definitions/PointCloud2.msg",
            "scenegen/model/weights/proposed.safetensors",
            "scenegen/py.typed",
        } <= set(archive.namelist())
    assert top == {"scenegen", "lidarsim"}
    python = environment(tmp_path / "env")
    (site,) = (tmp_path / "env" / "lib").glob("python*/site-packages")
    run(*f"{pip} install -q --no-deps --target {site} {wheel}".split())
    for name, content in USERS.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(content)
    (tmp_path / "mine.py").write_text(SCRIPT)
    assert run(python, "mine.py").startswith("extrude")
    assert "Usage: scenegen" in run(python, "-m", "scenegen", "--help")
    told = "from scenegen.base.errors import needs; print(needs('torch', 'train'))"
    assert f"'{wheel}[train]'" in run(python, "-c", told)
    small = "--n 5 --val 0 --test 5 --workers 1 --quiet"
    run(python, *f"-m scenegen generate --kind pillar {small}".split())
    words = "-m scenegen bench --method returns --quick --workers 1"
    assert "returns" in run(python, *words.split())


def test_what_figures_were_measured_with_is_allowed():
    """Every dependency of `all` has a version in benchmarks/constraints.txt, and within its
    bounds."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = (ROOT / "benchmarks" / "constraints.txt").read_text(encoding="utf-8").splitlines()[1:]
    measured = dict(line.split("==") for line in lines)
    extras = project["optional-dependencies"]
    (everything,) = map(Requirement, extras["all"])
    lines = [line for name in everything.extras for line in extras[name]]
    for needed in map(Requirement, [*project["dependencies"], *lines]):
        assert needed.specifier.contains(measured[needed.name]), needed


def test_who_cites_it_names_this_version():
    cited = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {scenegen.__version__}\n" in cited
