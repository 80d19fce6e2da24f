"""Datasets of an earlier generator: read, and verified fairly."""

import pytest

from scenegen.dataset.read import Dataset
from scenegen.verification import verify
from tests.scenegen.verification import forge
from tests.scenegen.verification.conftest import failed


@pytest.fixture
def older(folder):
    """A dataset of the first generator."""
    forge.sign(folder, generator=1)
    return folder


def again(folder):
    return next(check for check in verify(folder).checks if check.name == "regenerated")


def test_older_datasets_read_and_verify(older):
    assert Dataset(older).split("train")[0].tudf.size
    assert failed(older) == {}


def test_what_cannot_be_compared_is_counted_and_fails_nothing(older):
    forge.sign(older, seed=1)
    check = again(older)
    assert (check.ok, check.skipped, check.differing) == (True, False, {"flights": 3})
    assert check.counts == {"worlds": 3, "samples": 9}
    assert check.detail == (
        "3 flights come out otherwise here, made by generator 1, here is generator 2 "
        "(3 worlds, 9 samples)"
    )
