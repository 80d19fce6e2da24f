"""A dataset that a GPU cast the rays of, verified where there is none."""

from unittest.mock import Mock

import pytest

from lidarsim import AnalyticEngine
from lidarsim.gpu import WarpEngine
from scenegen.errors import DatasetError, SceneError
from scenegen.verification.folder import verify
from tests.conftest import dataset_in


def test_a_gpus_dataset_is_sound_without_one_but_for_what_cannot_be_made_again(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(WarpEngine, "missing", lambda: "")
    monkeypatch.setattr(WarpEngine, "of", AnalyticEngine.of)  # the same ranges
    dataset_in(tmp_path / "d", engine="warp")
    monkeypatch.setattr(WarpEngine, "missing", lambda: "needs a GPU")
    report = verify(tmp_path / "d")
    assert report.ok
    assert "made with the engine 'warp', which needs a GPU" in str(report)
    with pytest.raises(DatasetError, match=r"^the engine warp needs a GPU$"):
        dataset_in(tmp_path / "e", engine="warp")
    monkeypatch.setattr(WarpEngine, "missing", lambda: "")  # a driver is here, no GPU
    monkeypatch.setattr(WarpEngine, "of", Mock(side_effect=ValueError("Warp finds no GPU")))
    with pytest.raises(SceneError, match=r"^Warp finds no GPU$"):
        dataset_in(tmp_path / "e", engine="warp")
    assert not (tmp_path / "e").exists()
