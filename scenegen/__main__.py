"""The command line, `scenegen` and `python -m scenegen`: which commands there are. Each is imported
when it is given."""

from scenegen.cli import stops

if stops.is_command():  # before anything is imported that takes long
    stops.answer()

from typing import NoReturn

import rich_click as click

from scenegen import __version__
from scenegen.cli.command import Commands, run_command

LOOKING = ("inspect", "view", "render")
NETWORKS = ("train", "complete", "bench", "fly", "reproduce")
COMMANDS = (
    ("Datasets", "scenegen.cli.generate", ("generate", "recipe")),
    ("Datasets", "scenegen.cli.derive", ("rescan", "take", "merge")),
    ("Datasets", "scenegen.cli.verify", ("verify",)),
    ("Datasets", "scenegen.cli.publish", ("publish",)),
    ("Datasets", "scenegen.cli.convert", ("convert", "world")),
    ("Datasets", "scenegen.cli.maps", ("map", "ingest")),
    ("Sensors", "scenegen.cli.scan", ("sensors", "scan")),
    *(("To look at", f"scenegen.model.commands.{name}", (name,)) for name in LOOKING),
    *(("Networks", f"scenegen.model.commands.{name}", (name,)) for name in NETWORKS),
    ("Networks", "scenegen.model.commands.networks", ("calibrate", "export", "networks")),
    ("This machine", "scenegen.cli.doctor", ("doctor", "completion")),
)
"""Groups of the list, the modules, and the commands that stand there."""
PLACES = {name: f"{module}:{name}" for _, module, names in COMMANDS for name in names}
PANELS = [
    click.RichCommandPanel(
        panel, commands=[name for one, _, names in COMMANDS if one == panel for name in names]
    )
    for panel in dict.fromkeys(panel for panel, _, _ in COMMANDS)
]


def main() -> NoReturn:
    """Run the command line."""
    run_command(app)


@click.group(cls=Commands, places=PLACES, panels=PANELS)
@click.version_option(__version__, "-V", "--version", prog_name="scenegen")
def app() -> None:
    """Worlds, LiDAR scans and exact truth: datasets for 3D scene completion.

    A command of your own is given as module:command.
    """


if __name__ == "__main__":
    main()
