"""A campaign of mutated inputs: every command, fed what a stranger could have made of a valid file.

A *case* takes a valid input, damages it in one way that its number draws, and runs one command on
it, in a forked copy of a warm process, with limits of time and memory. It passes when the command
ends in time with a valid result, or in one printable line on standard error that begins with
``scenegen: ``, and leaves everything else as it was.

A case is named ``family/number``; with the seed, the name decides every byte of it:

    python -m tests.mutations                          # 25 cases of every family, seed 0
    python -m tests.mutations --cases 1000 --seed 7    # more, and others
    python -m tests.mutations scenes --cases 500       # of one family
    python -m tests.mutations scenes/17 --seed 7       # one case: prints all that it did, and keeps
    its folder

`python -m pytest -m slow tests/mutations` runs SCENEGEN_MUTATIONS of every family (300), by
SCENEGEN_MUTATION_SEED (1).
"""
