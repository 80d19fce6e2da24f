"""The command line, `scenegen` and `python -m scenegen`: which commands there are. Each is imported
when it is given."""

from scenegen.cli import stops

if stops.is_command():  # before anything is imported that takes long
    stops.answer()

from typing import NoReturn

import rich_click as click

from scenegen import __version__
from scenegen.cli.command import Commands, run_command

MADE, INFERRED = "scenegen.cli", "scenegen.model.commands"
OF_DATA = ("generate", "rescan", "world", "verify", "publish", "convert", "recipe")
OF_SENSORS = ("sensors", "scan")
OF_NETWORKS = ("train", "complete", "calibrate", "export", "networks", "bench", "reproduce")
OF_BOTH = ("inspect", "view", "render")
PLACES = {
    **{name: f"{MADE}.{name}:{name}" for name in OF_DATA},
    **{name: f"{INFERRED}.{name}:{name}" for name in (*OF_NETWORKS, *OF_BOTH)},
    **{name: f"{MADE}.{name}:{name}" for name in (*OF_SENSORS, "doctor", "completion")},
    **{name: f"{MADE}.gather:{name}" for name in ("take", "merge")},
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
