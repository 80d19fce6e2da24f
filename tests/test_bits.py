"""No stored bit depends on what the processor offers: the same digests where its features are
hidden."""

import json
import os

import numpy as np
import pytest

from tests.bits import of_datasets
from tests.command_line import ROOT, python

NUMPY = np._core._multiarray_umath
FEATURES = [name for name in NUMPY.__cpu_dispatch__ if NUMPY.__cpu_features__.get(name)]
HIDDEN = {
    "numpy": {"NPY_DISABLE_CPU_FEATURES": " ".join(FEATURES)},
    # glibc before 2.33 calls them *_Usable
    "libm": {
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-FMA_Usable,-AVX2,-AVX2_Usable,-FMA4,-FMA4_Usable"
    },
    "blas": {"OPENBLAS_CORETYPE": "Nehalem"},
    "numba": {"NUMBA_CPU_NAME": "generic"},
}
"""What hides a processor's features, part by part."""


@pytest.fixture(scope="module")
def digests():
    return of_datasets()


@pytest.mark.slow
@pytest.mark.parametrize("parts", [*([part] for part in HIDDEN), [*HIDDEN]])
def test_digests_are_the_same_where_parts_of_the_processor_are_hidden(parts, digests):
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    for part in parts:
        environment |= HIDDEN[part]
    hidden = json.loads(python("-W", "ignore", "-m", "tests.bits", env=environment).stdout)
    assert hidden == digests
