"""The command line.

`scenegen.__main__` lists the commands. `command` runs a command by its name and turns errors into
one line and an exit code; `stops` handles Ctrl-C. Commands take options from `options`, with types
from `types`, and print by `show`. Each other file has one command, or a few related ones.

The docstring of a command is its help page, up to a form feed; what follows is for readers of the
code.
"""
