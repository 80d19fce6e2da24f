"""Rank and world size of one of several equal jobs, from the environment."""

from collections.abc import Mapping

from scenegen.base.errors import DatasetError, short

RANKS = (
    ("SCENEGEN_RANK", "SCENEGEN_WORLD_SIZE"),
    ("JOB_COMPLETION_INDEX", "SCENEGEN_WORLD_SIZE"),
    ("RANK", "WORLD_SIZE"),
    ("SLURM_ARRAY_TASK_ID", "SLURM_ARRAY_TASK_COUNT"),
    ("SLURM_PROCID", "SLURM_NTASKS"),
)
"""Environment variables of rank and world size. The first pair that is set counts: the user's own
(for an indexed Job of Kubernetes only the size), then torchrun's, which starts several processes in
a task of Slurm, then Slurm's job arrays and tasks."""


def rank_of(environment: Mapping[str, str]) -> tuple[int, int]:
    """Read rank and world size from the environment.

    Args:
        environment: Environment variables.

    Returns:
        Rank, from 0, and world size.

    Raises:
        DatasetError: if they are missing or invalid.
    """
    names = next((pair for pair in RANKS if set(pair) <= environment.keys()), None)
    if names is None:
        ways = ", or ".join(" and ".join(pair) for pair in RANKS)
        raise DatasetError(f"--on rank: the environment tells no rank; set {ways}")
    values = [environment[name] for name in names]
    # a job array need not start at 0
    first = environment.get("SLURM_ARRAY_TASK_MIN", "0") if "ARRAY" in names[0] else "0"
    if all(value.isascii() and value.isdigit() for value in values):
        rank, size = int(values[0]) - int(first), int(values[1])
        if 0 <= rank < size:
            return rank, size
    raise DatasetError(
        f"--on rank: {names[0]}={short(values[0])}, {names[1]}={short(values[1])}; expected whole "
        "numbers, the first from 0 to one less than the second"
    )
