"""A dataset to bench on."""

import pytest

from scenegen.dataset.build import build, plan_dataset
from scenegen.dataset.read import Dataset
from scenegen.source import DrawnWorlds
from tests.conftest import small_recipe


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Nine test maps of three worlds."""
    folder = tmp_path_factory.mktemp("data")
    recipe = small_recipe(world={"density": (0.05, 0.1)})
    build(plan_dataset(folder, recipe, DrawnWorlds(recipe), seed=0, counts={"train": 3, "val": 4, "test": 9}))
    return Dataset(folder)
