"""Files of predictions: those that do not fit, or cannot be, are refused in one line."""

import contextlib

import h5py
import numpy as np
import pytest

from scenegen.base.errors import DatasetError
from scenegen.model.bench.methods import Predicted, tune
from scenegen.model.config import Thresholds
from tests.model.bench.test_bench import report_of, write_predictions


def test_predictions_that_do_not_fit_are_refused_before_anything_is_measured(dataset, tmp_path):
    path = tmp_path / "p.h5"
    write_predictions(path, dataset, drop=2)
    said = "2 of 9 samples are missing, or there twice, the first is world 0, viewpoint 0"
    with pytest.raises(DatasetError, match=said):
        report_of(dataset, tmp_path / "bench", "--predictions", path)
    assert not (tmp_path / "bench").exists()


ROWS = (9, 24, 24, 16)
"""Samples of the split, and the shape of their maps."""


def set_voxel(name, value):
    def change(file):
        file[name][3, 1, 2, 3] = value

    return change


def put(name, value, **options):
    def change(file):
        del file[name]
        file.create_dataset(name, data=value, **options)

    return change


def promise_a_terabyte(file):
    """Chunks that were never written: a file of a few kilobytes."""
    del file["tudf"]
    file.create_dataset("tudf", ROWS, np.float32, chunks=ROWS, maxshape=(None,) * 4)
    del file["occupancy_probability"], file["world"]
    file.create_dataset("world", (10**12,), np.int64, chunks=(10**6,))


def repeat_a_row(file):
    file["world"][1], file["viewpoint"][1] = file["world"][0], file["viewpoint"][0]


def leave_unwritten(file):
    """What a program leaves that ended too early."""
    del file["tudf"]
    file.create_dataset("tudf", ROWS, np.float32, chunks=(1, *ROWS[1:]))[:5] = 1.0


def link_outside(file):
    del file["tudf"]
    file["tudf"] = h5py.ExternalLink("/etc/passwd", "tudf")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            set_voxel("occupancy_probability", 7.0),
            "row 3: occupancy_probability holds 7, expected a probability",
        ),
        (set_voxel("tudf", -0.5), "row 3: tudf holds -0.5, expected a distance of at least 0"),
        (leave_unwritten, "tudf is not written to its end"),
        (repeat_a_row, "2 of 9 samples are missing"),
        (
            put("tudf", np.zeros((8, 24, 24, 16), np.float32)),
            "tudf has shape (8, 24, 24, 16), expected (9, 24",
        ),
        (put("tudf", np.zeros(ROWS, "S3")), "tudf is no array of float32"),
        (lambda file: file.move("world", "elsewhere"), "expected world, viewpoint"),
        (link_outside, "is no array of"),
        (lambda file: file.attrs.update({"split": np.arange(3)}), "predicts split"),
        (lambda file: file.attrs.update({"dataset": b"\x1b[31m\n"}), "predicts dataset"),
        (lambda file: (file.pop("tudf"), file.pop("occupancy_probability")), "at least one of"),
        (promise_a_terabyte, "viewpoint has shape (9,), expected (1000000000000,)"),
    ],
)
def test_predictions_that_cannot_be_are_refused_in_one_line(dataset, tmp_path, change, said):
    path = write_predictions(tmp_path / "p.h5", dataset)
    with h5py.File(path, "a") as file:
        change(file)
    with pytest.raises(DatasetError) as caught:
        Predicted(path).check(dataset, "test")
    assert said in str(caught.value)
    assert str(caught.value).isprintable()


def test_a_cut_or_scrambled_predictions_file_is_refused_in_one_line(dataset, tmp_path, rng):
    whole = write_predictions(tmp_path / "p.h5", dataset).read_bytes()
    for n in range(6):
        content = bytearray(whole)
        if n % 2:
            del content[int(rng.integers(len(whole))) :]
        else:
            start = int(rng.integers(4000))
            content[start : start + 64] = rng.bytes(64)
        (tmp_path / "p.h5").write_bytes(content)
        with contextlib.suppress(DatasetError):
            Predicted(tmp_path / "p.h5").check(dataset, "test")


def test_predictions_of_one_split_say_nothing_of_another(dataset, tmp_path):
    """Worlds are numbered from 0 in every split, so a row must go by its split, too."""
    predicted = Predicted(write_predictions(tmp_path / "p.h5", dataset))
    with pytest.raises(KeyError):
        predicted.completion(dataset.split("val")[0], dataset.split("val"))
    assert tune(predicted, dataset, thresholds=Thresholds()) == Thresholds()
