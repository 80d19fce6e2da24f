"""Results of a bench come back from their files as they were, or not at all."""

import dataclasses
from pathlib import Path

from scenegen.dataset.read import Dataset
from scenegen.model.completion.unlearned import Returns
from scenegen.model.evaluation.config import BenchConfig, PlanConfig
from scenegen.model.evaluation.keep import keep, kept
from scenegen.model.evaluation.methods import Completed, Truth
from scenegen.model.evaluation.report import build_report
from scenegen.model.evaluation.run import bench

CONFIG = BenchConfig(trials=12, plan=PlanConfig(step_voxels=2), study=True)


def test_a_result_comes_back_as_it_was_or_not_at_all(dataset: Dataset, tmp_path: Path) -> None:
    """The report made of it is the same, figure by figure; with another stamp, or damaged, there is none."""
    file, stamp = tmp_path / "folder" / "one.npz", {"dataset": "d", "plan": dataclasses.asdict(CONFIG.plan)}
    result = bench(dataset, [Truth(), Completed(Returns())], CONFIG)
    assert kept(file, CONFIG, stamp) is None
    keep(file, result, stamp)
    again = kept(file, CONFIG, stamp)
    assert again is not None
    first, second = (build_report([one], seed=0, about={}, tests=False) for one in (result, again))
    assert first == second
    assert kept(file, CONFIG, stamp | {"dataset": "other"}) is None
    content = file.read_bytes()
    for damage in (content[:-30], content[: len(content) // 2], b"", content[:400] + b"\0" * 40 + content[440:]):
        file.write_bytes(damage)
        assert kept(file, CONFIG, stamp) is None
