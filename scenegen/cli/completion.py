"""`scenegen completion`: what makes a shell complete the command line."""

import rich_click as click
from click.shell_completion import get_completion_class


@click.command()
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
@click.pass_context
def completion(ctx: click.Context, shell: str) -> None:
    """Print a completion script: eval "$(scenegen completion bash)"."""
    found = get_completion_class(shell)
    assert found is not None
    print(found(ctx.find_root().command, {}, "scenegen", "_SCENEGEN_COMPLETE").source())
