"""`scenegen networks`: what the variants cost."""

import json

import rich_click as click

from scenegen.cli.options import json_option
from scenegen.cli.show import say


@click.command()
@json_option
def networks(as_json: bool) -> None:
    """Print what the network's variants cost: parameters, multiply-accumulates, memory."""
    from scenegen.model.summary import costs

    found = costs()
    if as_json:
        print(json.dumps(found))
        return
    say(f"{'variant':<10}{'stem stride':>12}{'parameters':>12}{'GMACs':>8}{'activations':>13}")
    for row in found:
        say(
            f"{row['variant']:<10}{row['stem_stride']:>12}{row['parameters']:>12,}{row['macs'] / 1e9:>8.2f}"
            f"{row['activation_bytes'] / 1e6:>10.1f} MB"
        )
