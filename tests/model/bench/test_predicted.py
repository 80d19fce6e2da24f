"""Files of predictions: those that do not fit, or cannot be, are refused in one line."""

from functools import partial

import h5py
import numpy as np
import pytest

from scenegen.model.bench.methods import Predicted, tune
from scenegen.model.config import Thresholds
from tests.model.bench.test_bench import report_of, write_predictions
from tests.refusals import refuses

ROWS = (9, 24, 24, 16)
"""Samples of the split, and the shape of their maps."""


def set_voxel(file, name, value):
    file[name][3, 1, 2, 3] = value


def put(file, name, **options):
    """Another array under the name."""
    del file[name]
    return file.create_dataset(name, **options)


def promise_a_terabyte(file):
    """Chunks that were never written: a file of a few kilobytes."""
    put(file, "tudf", shape=ROWS, dtype=np.float32, chunks=ROWS, maxshape=(None,) * 4)
    del file["occupancy_probability"]
    put(file, "world", shape=10**12, dtype=np.int64, chunks=(10**6,))


def repeat_a_row(file):
    file["world"][1], file["viewpoint"][1] = file["world"][0], file["viewpoint"][0]


def leave_unwritten(file):
    """What a program leaves that ended too early."""
    put(file, "tudf", shape=ROWS, dtype=np.float32, chunks=(1, *ROWS[1:]))[:5] = 1.0


def link_outside(file):
    del file["tudf"]
    file["tudf"] = h5py.ExternalLink("/etc/passwd", "tudf")


CHANGES = {
    "seven": partial(set_voxel, name="occupancy_probability", value=7.0),
    "negative": partial(set_voxel, name="tudf", value=-0.5),
    "unwritten": leave_unwritten,
    "repeated": repeat_a_row,
    "short": partial(put, name="tudf", shape=(8, *ROWS[1:]), dtype=np.float32),
    "text": partial(put, name="tudf", shape=ROWS, dtype="S3"),
    "moved": lambda file: file.move("world", "elsewhere"),
    "linked": link_outside,
    "split": lambda file: file.attrs.update({"split": np.arange(3)}),
    "dataset": lambda file: file.attrs.update({"dataset": b"\x1b[31m\n"}),
    "nothing": lambda file: (file.pop("tudf"), file.pop("occupancy_probability")),
    "terabyte": promise_a_terabyte,
}


@pytest.mark.parametrize("change", CHANGES)
def test_impossible_predictions_are_refused(dataset, tmp_path, change):
    path = write_predictions(tmp_path / "p.h5", dataset)
    with h5py.File(path, "a") as file:
        CHANGES[change](file)
    refuses(change, lambda: Predicted(path).check(dataset, "test"))


def test_nothing_is_measured_of_other_samples(dataset, tmp_path):
    path = write_predictions(tmp_path / "p.h5", dataset, drop=2)
    refuses("two", report_of, dataset, tmp_path / "bench", "--predictions", path)
    assert not (tmp_path / "bench").exists()


def test_predictions_of_one_split_say_nothing_of_another(dataset, tmp_path):
    """Worlds are numbered from 0 in every split, so a row must go by its split, too."""
    predicted = Predicted(write_predictions(tmp_path / "p.h5", dataset))
    with pytest.raises(KeyError):
        predicted.completion(dataset.split("val")[0], dataset.split("val"))
    assert tune(predicted, dataset, thresholds=Thresholds()) == Thresholds()
