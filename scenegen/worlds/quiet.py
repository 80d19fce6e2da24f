"""MuJoCo without a word of its own: no warning on the terminal, no MUJOCO_LOG.TXT in the working
folder."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import mujoco


@contextmanager
def quiet_mujoco() -> Iterator[list[str]]:
    """While the block runs, MuJoCo's warnings go to the list that it gets, and to nothing else.

    Left alone, MuJoCo prints them and appends them to a file in the working folder. Whoever else
    uses MuJoCo in this process finds its own handler again afterwards.
    """
    told: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(told.append)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield told
    finally:
        mujoco.set_mju_user_warning(before)
