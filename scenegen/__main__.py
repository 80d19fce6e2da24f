"""The command line, `scenegen` and `python -m scenegen`: which commands there are. Each is imported
when it is given."""

from scenegen.cli import stops

if stops.is_command():  # before anything is imported that takes long
    stops.answer()

from typing import NoReturn

import rich_click as click

from scenegen import __version__
from scenegen.cli.command import Commands, run_command

COMMANDS = {
    "Datasets": {
        "scenegen.cli.generate": "generate recipe",
        "scenegen.cli.take": "take",
        "scenegen.cli.verify": "verify",
        "scenegen.cli.publish": "publish",
        "scenegen.cli.convert": "convert world map ingest",
    },
    "Sensors": {"scenegen.cli.scan": "sensors scan"},
    "To look at": {"scenegen.cli.inspect": "inspect view", "scenegen.cli.render": "render"},
    "Networks": {
        "scenegen.cli.train": "train",
        "scenegen.cli.complete": "complete",
        "scenegen.cli.bench": "bench calibrate export",
        "scenegen.cli.fly": "fly",
    },
    "This machine": {"scenegen.cli.doctor": "doctor completion"},
}
"""Groups of the list, and the commands of each by the modules in which they stand."""
PLACES = {
    name: f"{module}:{name}"
    for modules in COMMANDS.values()
    for module, names in modules.items()
    for name in names.split()
}
PANELS = [
    click.RichCommandPanel(group, commands=" ".join(modules.values()).split())
    for group, modules in COMMANDS.items()
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
