"""A dataset to bench on."""

import pytest

from scenegen import Dataset
from tests.model.conftest import make_dataset

COUNTS = {"train": 3, "val": 4, "test": 9}


@pytest.fixture(scope="session")
def dataset(once):
    """Nine test maps of three worlds."""
    return Dataset(
        once(
            "dense",
            lambda folder: make_dataset(folder, counts=COUNTS, world={"density": (0.05, 0.1)}),
        )
    )
