# ruff: noqa
# mypy: ignore-errors
"""python held.py NETWORK...: IoU over known voxels at home's best threshold, on held-out maps."""
import sys
sys.path.insert(0, "benchmarks")
import numpy as np
from real import *
from scenegen.model.bench.methods import rows_of
T = Path("/tmp/places/held"); T.mkdir(exist_ok=True)
N = int(sys.argv[1]); methods = rows_of(["conservative"], sys.argv[2:])
home = {f"`{k}`": counted(seen_in(drawn(T / f"{k}-val", preset(k), 50, split="val", seed=9)), methods) for k in KINDS}
best = best_in(home)
files = sorted(Path("/tmp/places/recheld").glob("*.npz"))
places = {}
for f in files:
    try:
        ds = drawn(T / f.stem, preset("scene"), N, scenes=f, split="train", viewpoints=1)
    except Exception as e:
        print(f.stem, e); continue
    places[f.stem] = counted(seen_in(ds), methods)
names = [m.name for m in methods]
def row(title, c): print(f"{title:16s}", *(f"{c[n].iou[:, best[n]].mean():.3f} {np.mean([brief_ece(c[n])]):.3f} {np.quantile(c[n].denied,.5):.3f}" for n in names), sep=" | ")
def brief_ece(c):
    s = c.ece.split(" → ")[-1]; return float(s.split()[0])
print("threshold", {n: THRESHOLDS[b] for n, b in best.items()}); print("IoU, ECE, median denied:", names)
for t, c in (home | places).items(): row(t, c)
m = {n: [places[p][n].iou[:, best[n]].mean() for p in places] for n in names}
print("places", len(places), {n: round(float(np.mean(v)), 4) for n, v in m.items()})
print("home", {n: round(float(np.mean([home[k][n].iou[:, best[n]].mean() for k in home])), 4) for n in names})
for n in names[1:]:
    hd = np.concatenate([home[k][n].denied for k in home]); pd = np.concatenate([places[p][n].denied for p in places])
    print(n, "alarm at home's .95:", (pd > np.quantile(hd, .95)).mean().round(3))
