"""The command line of datasets, worlds and sensors; that of networks is in `scenegen.model`.

`scenegen.__main__` lists the commands. `command` runs a command by name and turns its end into a
line and an exit code, `stops` answers Ctrl-C. A command takes its options from `options`, their
types from `types`, and prints through `show`. The other files hold a command or a few that belong
together.
"""
