"""Training on maps of your own, from `train.npz` and `val.npz`."""

import hashlib
from pathlib import Path
from types import SimpleNamespace

import numpy as np

import scenegen
from lidarsim import GridSpec, Lidar


class Recorded:
    """Maps of a file: `observed` and `occupancy`, bool (n, 80, 80, 40), sensor in the middle."""

    grid, lidar, kind = GridSpec(), Lidar(), "yard"

    def __init__(self, file: str):
        self.name, self.digest = file, hashlib.sha256(Path(file).read_bytes()).hexdigest()
        with np.load(file) as arrays:
            self.observed, self.occupancy = arrays["observed"], arrays["occupancy"]

    def __len__(self) -> int:
        return len(self.observed)

    def __getitem__(self, n: int) -> SimpleNamespace:
        return SimpleNamespace(observed=self.observed[n], occupancy=self.occupancy[n])


scenegen.train(Recorded("train.npz"), Recorded("val.npz"), maps=5000, out="runs/yard")
