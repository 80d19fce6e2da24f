# ruff: noqa
# mypy: ignore-errors
"""python noise_eval.py NETWORK...: IoU of real scans of the HDL-64E; those that noise was fitted on are left out."""
import sys
sys.path.insert(0, "benchmarks")
import real
from real import *
from scipy import stats
real.SCANS = 16
names = sys.argv[1:]; methods = rows_of([], names)
T85 = int(np.argmin(abs(THRESHOLDS - .85)))
iou = {}
for place in ("kitti00", "kitti07"):
    seen = seen_by_others(Path("/tmp/places/maps/logs") / place)
    if place == "kitti00": seen = [s for n, s in enumerate(seen) if n not in (1, 3, 5)]
    found = counted(seen, methods)
    for m in methods: iou[place, m.name] = found[m.name].iou
    for m in methods:
        i = iou[place, m.name]; b = int(i.mean(axis=0).argmax())
        print(place, m.name, len(i), "at .85", told(i[:, T85], range(len(i)), ".3f"), "best", THRESHOLDS[b], told(i[:, b], range(len(i)), ".3f"), flush=True)
def diff(a, b):
    for place in ("kitti00", "kitti07", "both"):
        ps = ("kitti00", "kitti07") if place == "both" else (place,)
        for what in ("at .85", "best"):
            def v(m, p):
                i = iou[p, m]; return i[:, T85] if what == "at .85" else i[:, int(i.mean(axis=0).argmax())]
            d = np.concatenate([v(a, p) - v(b, p) for p in ps])
            print(f"{a} less {b}", place, what, told(d, range(len(d)), "+.4f"))
ns = [m.name for m in methods]
for a in ns[1:]:
    for b in ns[: ns.index(a)]: diff(a, b)
