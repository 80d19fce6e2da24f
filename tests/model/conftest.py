"""Two small datasets and small networks; one thread, since tests run side by side."""

from pathlib import Path

import pytest
import torch

from scenegen.dataset.build import build, plan_dataset
from scenegen.source import DrawnWorlds
from tests.conftest import small_recipe

COUNTS = {"train": 12, "val": 6, "test": 5}


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def make_dataset(folder: Path, kind: str = "pillar", *, compact: bool = False, seed: int = 0, **tables: dict) -> Path:
    """A dataset of a few small maps."""
    recipe = small_recipe(kind, **tables)
    plan = plan_dataset(folder, recipe, DrawnWorlds(recipe), seed=seed, counts=COUNTS, compact=compact, shard_samples=5)
    build(plan, workers=1, force=False)
    return folder


@pytest.fixture(scope="session")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """One dataset of each kind; the second leaves out what can be derived."""
    base = tmp_path_factory.mktemp("data")
    return [make_dataset(base / "pillar"), make_dataset(base / "geometric", "geometric", compact=True)]
