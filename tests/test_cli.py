"""The command line as a whole: what it loads, how it ends, and what it lets nobody print."""

import inspect
import json
import subprocess
import sys
import warnings

import click
import pytest

from scenegen import __version__
from scenegen.__main__ import PLACES, app
from scenegen.cli.options import COMMON_GROUPS
from scenegen.model.config import BenchConfig
from tests.command_line import ROOT, done, modules_after, run


def test_version_completion_and_doctor(capsys, monkeypatch):
    monkeypatch.setattr("scenegen.cli.doctor.SELF_TEST_S", 0.1)
    assert __version__ in run(capsys, "--version")[1] == run(capsys, "-V")[1]
    assert "_SCENEGEN_COMPLETE" in run(capsys, "completion bash")[1]
    found = json.loads(done(capsys, "doctor --json"))
    assert found["ok"]
    assert found["mujoco"] == found["ompl"] == "loads"


HEAVY = {"torch", "mujoco", "numba", "h5py", "ompl", "scipy", "numpy"}


PLACES_OF_COMMANDS = {place.partition(":")[0] for place in PLACES.values()}


@pytest.mark.parametrize(("words", "commands"), [("", 0), ("bench", 1), ("generate", 1)])
def test_help_imports_no_other_command_and_nothing_heavy(words, commands):
    argv = ["scenegen", *words.split(), "--help"]
    found = modules_after(f"sys.argv = {argv}; from scenegen.__main__ import main; main()")
    assert not found & HEAVY
    assert len(found & PLACES_OF_COMMANDS) == commands


def test_every_command_says_in_the_list_what_it_says_itself(capsys):
    for name in app.registry.builtin:
        command = app.registry.find(name)
        assert command.name == name
        assert inspect.cleandoc(command.help).startswith(app.get_command(None, name).help)
        assert "Of " not in done(capsys, name, "--help")


def commands_of_all_groups():
    commands = {name: app.registry.find(name) for name in app.registry.builtin}
    groups = {name: getattr(command, "commands", {}) for name, command in commands.items()}
    return commands | {
        f"{name} {sub}": group[sub] for name, group in groups.items() for sub in group
    }


def test_examples_and_groups_on_help_pages_are_of_the_command_and_its_options():
    examples = 0
    for name, command in commands_of_all_groups().items():
        options = {word for option in command.params for word in option.opts}
        for line in (command.epilog or "").split("\n\n")[1:]:
            examples += 1
            assert line.startswith(f"scenegen {name}")
            words = line.removeprefix(f"scenegen {name}").split()
            command.make_parser(click.Context(command)).parse_args(words)
            for panel in command.panels:
                assert panel.name in COMMON_GROUPS or options.issuperset(panel.options)
    assert examples > 20


def test_defaults_of_bench_stand_twice_and_are_the_same():
    """The command may not import what knows them: it would take a second."""
    config = BenchConfig()
    options = {option.name: option.default for option in app.registry.find("bench").params}
    assert (options["split"], options["seed"]) == (config.split, config.seed)


@pytest.fixture
def completed(capsys, monkeypatch):
    """What the shell is offered for the last of some words."""

    def offered(words):
        monkeypatch.setenv("_SCENEGEN_COMPLETE", "bash_complete")
        monkeypatch.setenv("COMP_WORDS", f"scenegen {words}")
        monkeypatch.setenv("COMP_CWORD", str(len(words.split()) + words.endswith(" ")))
        return [line.partition(",")[2] for line in run(capsys, "")[1].splitlines()]

    return offered


def test_the_shell_completes_commands_options_kinds_and_networks(completed):
    assert completed("comp") == ["complete", "completion"]
    assert "--epochs" in completed("train --e")
    assert completed("generate --kind pil") == ["pillar"]
    assert completed("bench --weights pro") == ["proposed"]
    # which is not there, and nobody is told off for it
    assert "generate" in completed("nowhere:command ")


def test_printing_in_vain_changes_no_verdict(made):
    """Output that is lost is told and ends with 1; nobody need read standard error, nor all of the
    output."""
    verify = f"{sys.executable} cli.py verify --quick {made}"
    script = f"{sys.executable} cli.py completion bash"
    lost = "scenegen: standard output: {}; what was to be printed is lost\n".format
    expected = {
        f"{verify} 2>/dev/full >/dev/null": (0, ""),
        f"{script} >&-": (1, lost("Bad file descriptor")),
        f"{script} >/dev/full": (1, lost("No space left on device")),
        f"({script}; echo $? >&2) | true": (0, "0\n"),
    }
    how = {"shell": True, "cwd": ROOT, "stderr": subprocess.PIPE, "text": True}
    running = [subprocess.Popen(words, **how) for words in expected]
    for process, (command, (code, error)) in zip(running, expected.items(), strict=True):
        assert (process.communicate(timeout=120)[1], process.returncode) == (error, code), command


def test_warnings_of_libraries_reach_nobody(monkeypatch, capfd):
    def warn():
        warnings.warn("settotalmass is deprecated", stacklevel=1)
        return {"ok": True}

    monkeypatch.setattr("scenegen.cli.doctor.examine", warn)
    assert run(capfd, "doctor", "--json") == (0, '{"ok": true}\n', "")
