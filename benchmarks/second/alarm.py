# ruff: noqa
# mypy: ignore-errors
"""python alarm.py MAPS N NETWORK...: how often `away` is .95 or more, by place and at home."""
import sys
sys.path.insert(0, "benchmarks")
import numpy as np
from real import *
from real import real_places
maps, n, *names = sys.argv[1:]
methods = rows_of([], names)
T = Path("/tmp/places/alarm"); T.mkdir(exist_ok=True)
sets = {f"`{k}`": drawn(T / k, preset(k), 200, split="test", viewpoints=1, seed=77) for k in KINDS}
others = ("rooms", "street", "forest", "cave", "warehouse", "industrial", "maze", "clutter")
sets |= {f"drawn {k}": drawn(T / k, preset(k), 40, split="test", viewpoints=1, seed=77) for k in others}
sets |= real_places(Path(maps), Path("/tmp/places/realdata"), int(n))
rates = {m.name: {} for m in methods}
for place, ds in sets.items():
    seen = seen_in(ds)[:(60 if place[0] == "`" else 12)]
    for m in methods:
        aways = [float(m.completion(s.sample, s.source).away) for s in seen]
        rates[m.name][place] = np.mean(np.array(aways) >= .95)
    print(f"{place:20s}", len(seen), *(f"{rates[m.name][place]:.3f}" for m in methods), flush=True)
for m in methods:
    r = rates[m.name]
    by = {}
    for p in r:
        if PLACES.get(p, {}).get("place"): by.setdefault(PLACES[p]["place"], []).append(r[p])
    v = [np.mean(x) for x in by.values()]
    print(m.name, "home", np.mean([r[f'`{k}`'] for k in KINDS]).round(4), "other drawn", np.mean([r[f'drawn {k}'] for k in others]).round(3), "places", np.mean(v).round(3), "n", len(v))
