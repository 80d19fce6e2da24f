# ruff: noqa
# mypy: ignore-errors
"""python samples.py MAPS OUT COUNT SEED PART PARTS: a dataset of each map in which flights fit."""

import sys
import time

from pathlib import Path
sys.path.insert(0, str(Path(__file__).parents[1]))
from pathlib import Path

from scoring import drawn

from scenegen.worlds.recipe import make_recipe

maps, out, count, seed, part, parts = sys.argv[1:]
usual = {"flight": {"robot_radius_m": 0.25, "min_distance_m": 4.0, "viewpoints": 3, "step_m": 0.5}}
noisy = usual | {
    "lidar": {"sensor": "ouster-os1-64"},
    "noise": {"stages": "range:0.02,dropout:0.05"},
}
Path(out).mkdir(exist_ok=True)
files = sorted(Path(maps).glob("*.npz"), key=lambda f: (f.stem[-3:], f.stem))
for n, file in enumerate(files):
    if n % int(parts) != int(part):
        continue
    if int(file.stem[-3:]) < 6 or Path(out, file.stem).exists():
        continue
    begin = time.process_time()
    how = noisy if int(file.stem[-3:]) == 5 else usual
    try:
        drawn(
            Path(out, file.stem),
            make_recipe("scene", how),
            int(count) // (4 if how is noisy else 1),
            scenes=file,
            split="train",
            seed=int(seed) + n,
        )
    except Exception as error:
        print(file.stem, "left out:", str(error)[:100], flush=True)
        continue
    print(file.stem, f"{time.process_time() - begin:.1f} s", flush=True)
