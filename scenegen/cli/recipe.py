"""`scenegen recipe`: a kind's preset as a file to edit."""

from pathlib import Path

import rich_click as click

from scenegen.cli.options import lidar_option, out_option
from scenegen.cli.types import Named
from scenegen.recipes import KINDS


@click.command()
@click.argument("kind", type=Named(KINDS))
@lidar_option("The sensor", "  [default: the kind's]")
@out_option("The file to write.  [default: standard output]", file=True)
def recipe(kind: str, lidar: str | None, out: Path | None) -> None:
    """Print the preset of a kind of worlds as a recipe, every parameter with its value, for
    `generate --recipe`."""
    from lidarsim import Lidar
    from scenegen.cli.show import say
    from scenegen.dataset import manifest
    from scenegen.errors import RecipeError
    from scenegen.files import write_result
    from scenegen.lidar import named_lidar
    from scenegen.recipe import preset
    from scenegen.share.regenerate import recipe_text
    from scenegen.source import DrawnWorlds

    found = preset(kind, lidar=named_lidar(lidar) if lidar else None)
    if not isinstance(found.lidar, Lidar):
        raise RecipeError(
            f"--lidar {lidar}: is no raster, which a recipe file could hold; give it to generate "
            f"--lidar"
        )
    counts = {"train": 0, "val": 0, "test": 0}
    given = manifest.parameters(
        found, DrawnWorlds(found), seed=0, counts=counts, compact=False, shard_samples=1
    )
    text = recipe_text(given, f"the preset of {kind}, version {found.version}; lengths are metres")
    if out is None:
        say(text.rstrip())
    else:
        write_result(out, text.encode())
