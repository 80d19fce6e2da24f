"""`scenegen export`: a network as ONNX."""

from pathlib import Path

import rich_click as click

from scenegen.cli.options import out_option
from scenegen.cli.show import say
from scenegen.model.commands.weights import Weights
from scenegen.model.config import DEFAULT_NETWORK, split_own


@click.command()
@click.argument("weights", type=Weights(), default=DEFAULT_NETWORK)
@out_option("File to write.  [default: <name>.onnx]", file=True)
def export(weights: str, out: Path | None) -> None:
    """Write a network as ONNX, for the runtimes that are fastest on CPUs."""
    from scenegen.files import check_ours
    from scenegen.model.completion.completer import open_network
    from scenegen.model.export import export_onnx

    network, grid, about = open_network(weights)
    out = out or Path(f"{Path(split_own(weights)[1]).stem}.onnx")
    check_ours(out)
    export_onnx(network, grid, out, about=about)
    say(f"written: {out}")
