"""A dataset that a GPU cast the rays of, verified where there is none."""

import pytest

from lidarsim import AnalyticEngine
from lidarsim.gpu import WarpEngine
from scenegen.dataset.build import build
from scenegen.errors import DatasetError
from scenegen.verification.folder import verify
from tests.conftest import plan_of, small_recipe


def test_a_gpus_dataset_is_sound_without_one_but_for_what_cannot_be_made_again(
    tmp_path, monkeypatch
):
    recipe, counts = small_recipe(), {"train": 3, "val": 0, "test": 0}
    monkeypatch.setattr(WarpEngine, "missing", lambda: "")
    monkeypatch.setattr(WarpEngine, "of", AnalyticEngine.of)  # the same ranges
    plan = plan_of(tmp_path / "d", recipe, counts=counts, engine="warp")
    build(plan)
    monkeypatch.setattr(WarpEngine, "missing", lambda: "needs a GPU")
    report = verify(tmp_path / "d")
    assert report.ok
    assert "made with the engine 'warp', which needs a GPU" in str(report)
    with pytest.raises(DatasetError, match=r"^the engine warp needs a GPU$"):
        plan_of(tmp_path / "e", recipe, counts=counts, engine="warp")
    assert not (tmp_path / "e").exists()
