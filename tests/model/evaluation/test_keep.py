"""Results of a bench come back from their files as they were, or not at all."""

import dataclasses
from pathlib import Path

import numpy as np

from scenegen.dataset.read import Dataset
from scenegen.model.completion.unlearned import Returns
from scenegen.model.evaluation.config import BenchConfig, PlanConfig
from scenegen.model.evaluation.keep import keep, kept
from scenegen.model.evaluation.methods import Completed, Truth
from scenegen.model.evaluation.report import build_report
from scenegen.model.evaluation.run import bench
from scenegen.model.reproduce.records import Measured, Records

CONFIG = BenchConfig(trials=12, plan=PlanConfig(step_voxels=2), study=True)


def test_a_result_comes_back_as_it_was_or_not_at_all(dataset: Dataset, tmp_path: Path) -> None:
    """The report made of it is the same, figure by figure; with another stamp, or damaged, there is
    none."""
    file, stamp = (
        tmp_path / "folder" / "one.npz",
        {"dataset": "d", "plan": dataclasses.asdict(CONFIG.plan)},
    )
    result = bench(dataset, [Truth(), Completed(Returns())], CONFIG)
    assert kept(file, CONFIG, stamp) is None
    keep(file, result, stamp)
    again = kept(file, CONFIG, stamp)
    assert again is not None
    first, second = (build_report([one], seed=0, about={}, tests=False) for one in (result, again))
    assert first == second
    assert kept(file, CONFIG, stamp | {"dataset": "other"}) is None
    content = file.read_bytes()
    for damage in (
        content[:-30],
        content[: len(content) // 2],
        b"",
        content[:400] + b"\0" * 40 + content[440:],
    ):
        file.write_bytes(damage)
        assert kept(file, CONFIG, stamp) is None


def test_records_hold_every_map_and_trial_of_a_bench(dataset: Dataset, tmp_path: Path) -> None:
    result = bench(
        dataset, [Truth(), Completed(Returns())], dataclasses.replace(CONFIG, study=False)
    )
    Records(runs={}, measured=(Measured.of("sparse", result),)).write(tmp_path / "records.npz")
    (one,) = Records.read(tmp_path / "records.npz").measured
    assert (one.where, one.kind, one.rows) == ("sparse", result.kind, ("truth", "returns"))
    for name, found in result.methods.items():
        np.testing.assert_allclose(
            one.values("near_rmse", name), found.reconstruction[:, 0, 2], rtol=1e-3, atol=1e-6
        )
        assert one.values("success", name).tolist() == [trial.success for trial in found.trials]
        lengths = [trial.length_m for trial in found.trials]
        np.testing.assert_allclose(one.values("length", name), lengths, rtol=1e-3)
    np.testing.assert_array_equal(one.worlds_of("iou"), result.worlds)
    np.testing.assert_array_equal(one.worlds_of("success"), result.trial_worlds)
