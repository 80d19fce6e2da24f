"""The command line, `scenegen` and `python -m scenegen`: which commands there are. Each is imported
when it is given."""

from scenegen.cli import stops

if stops.is_command():  # before anything is imported that takes long
    stops.answer()

from typing import NoReturn

import rich_click as click

from scenegen import __version__
from scenegen.cli.command import Commands, run_command

FILES = {
    "scenegen.cli": {
        **{name: name for name in ("generate", "rescan", "world", "verify", "publish", "convert")},
        **{name: name for name in ("recipe", "sensors", "scan", "doctor", "completion")},
        **dict.fromkeys(("take", "merge"), "gather"),
    },
    "scenegen.model.commands": {
        **{name: name for name in ("train", "complete", "bench", "reproduce")},
        **dict.fromkeys(("calibrate", "export", "networks"), "networks"),
        **dict.fromkeys(("inspect", "view", "render"), "view"),
    },
}
"""Commands by package, each with the module that it stands in."""
PLACES = {
    name: f"{package}.{file}:{name}"
    for package, files in FILES.items()
    for name, file in files.items()
}


def main() -> NoReturn:
    """Run the command line."""
    run_command(app)


@click.group(cls=Commands, places=PLACES)
@click.version_option(__version__, "-V", "--version", prog_name="scenegen")
def app() -> None:
    """Worlds, LiDAR scans and exact truth: datasets for 3D scene completion.

    A command of your own is given as module:command.
    """


if __name__ == "__main__":
    main()
