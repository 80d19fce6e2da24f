"""Every process of the tests computes on one thread, and so do those that it starts: as many run as
there are cores."""

import os

for _pool in ("OMP", "OPENBLAS", "MKL"):  # before any of them is loaded
    os.environ.setdefault(f"{_pool}_NUM_THREADS", "1")
