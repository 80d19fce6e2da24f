"""Variants of the dataset `made`, and what manifests of strangers are refused for."""

import pytest

from scenegen.dataset.read import Dataset
from tests.conftest import COUNTS, dataset_in, small_recipe

NOISE = "range:0.02,dropout:0.05"
SEVERAL = {"scans": 4, "scan_spacing_m": 0.7}


def made_with(folder, **tables):
    """The dataset of `made`, with other tables of the recipe."""
    return dataset_in(folder, small_recipe(**tables), seed=3, counts=COUNTS, shard_samples=3)


@pytest.fixture(scope="session")
def noisy(once):
    """The dataset of `made`, with noise; not to be changed."""
    folder = once("noisy", lambda folder: made_with(folder / "d", noise={"stages": NOISE}))
    return Dataset(folder / "d")


@pytest.fixture(scope="session")
def several(once):
    """The dataset of `made`, with four scans a sample; not to be changed."""
    folder = once("several-scans", lambda folder: made_with(folder / "d", mapping=SEVERAL))
    return Dataset(folder / "d")
