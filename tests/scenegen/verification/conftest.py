"""One small dataset of each kind, made once a test process; tests change copies."""

import pytest

from scenegen.verification import verify
from tests.refusals import check_wording
from tests.scenegen.verification import forge


@pytest.fixture(scope="session")
def originals(once):
    """Datasets by their kind; not to be changed."""
    kinds = "pillar", "geometric"
    made = once("originals", lambda folder: [forge.make(folder / kind, kind) for kind in kinds])
    return {kind: made / kind for kind in kinds}


@pytest.fixture
def folder(originals, tmp_path):
    """A dataset to plant faults in."""
    return forge.copy(originals["pillar"], tmp_path / "pillar")


def finds(case, folder, check, **options):
    """A check fails, in the line that the snapshot has for this case; all that failed."""
    faults = failed(folder, **options)
    check_wording(case, faults[check])
    return faults


def failed(folder, **options):
    """Checks that failed, and what they said."""
    report = verify(folder, **options)  # type: ignore[arg-type]
    said = {check.name: check.detail for check in report.checks if not check.ok}
    assert all("\n" not in line for line in said.values())
    return said
