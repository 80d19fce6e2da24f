"""A page with predictions shows what they say, what they miss and what they invent."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from scenegen.dataset.build import build, plan_dataset
from scenegen.dataset.read import Dataset
from scenegen.source import DrawnWorlds
from tests.command_line import run
from tests.conftest import small_recipe
from tests.scenegen.view.test_page import Seen, unpacked

COUNTS = {"train": 3, "val": 0, "test": 3}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    recipe = small_recipe()
    folder = tmp_path_factory.mktemp("shown") / "d"
    build(plan_dataset(folder, recipe, DrawnWorlds(recipe), seed=0, counts=COUNTS), workers=1)
    return folder


def test_errors_of_predictions_are_layers_of_the_page(folder: Path, tmp_path: Path, capsys: Any) -> None:
    dataset = Dataset(folder)
    samples = dataset.split("test")
    rng = np.random.default_rng(0)
    guesses = rng.random((len(samples), *dataset.grid.shape)).astype(np.float32)
    with h5py.File(tmp_path / "p.h5", "w") as file:
        file.attrs.update({"dataset": dataset.manifest.digest, "split": "test"})
        file["occupancy_probability"] = guesses
        for name in ("world", "viewpoint"):
            file[name] = np.array([getattr(sample, name) for sample in samples], np.int64)
    words = ("view", folder, "--predictions", tmp_path / "p.h5", "-o", tmp_path / "page.html", "--quiet")
    code, _, said = run(capsys, *words, "--split", "test")
    assert (code, said) == (0, "")
    shown = Seen((tmp_path / "page.html").read_text(encoding="utf-8")).data()["samples"]
    assert len(shown) == len(samples)
    for packed, sample, guess in zip(shown, samples, guesses > 0.85, strict=True):
        masks = {
            name: np.unpackbits(np.frombuffer(unpacked(text), np.uint8))[: guess.size].reshape(guess.shape).astype(bool)
            for name, text in packed["masks"].items()
        }
        np.testing.assert_array_equal(masks["predicted"], guess)
        np.testing.assert_array_equal(masks["missed"] | (guess & sample.occupancy), sample.occupancy)
        np.testing.assert_array_equal(masks["invented"] | (guess & sample.occupancy), guess)
        assert not (masks["missed"] & masks["predicted"]).any()
    code, _, said = run(capsys, *words, "--split", "train")  # which the file does not predict
    assert (code, said.count("\n")) == (1, 1)
    assert "p.h5" in said
