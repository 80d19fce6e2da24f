r"""What can be known from one scan of a pillar world or a maze: docs/results/ceiling.md.

    python benchmarks/ceiling.py ROOT --annealed 5    # samples worlds for every map, then scores
    python benchmarks/ceiling.py MAZES --kind maze --maps 120 --annealed 6 \
        --steps 2000 --heating 20000
    python benchmarks/ceiling.py ROOT --sample-only   # in the background; a stopped run goes on

ROOT gets the maps, and a file for each with worlds that look the same through its scan. Several of
these commands with different --part may work on one ROOT. Maps with even numbers choose thresholds;
the figures are of those with odd numbers.
"""

import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import mazes
import measuring
import numpy as np
import posterior
import scoring
from posterior import Looked
from scoring import drawn, publish, titled, told
from tyro.conf import Positional

from lidarsim import Pose
from lidarsim.grid import Floats, GridSpec, Mask
from scenegen import Dataset, Sample, preset
from scenegen.dataset.read import Split
from scenegen.draw.draw import WORLD, UnitKey
from scenegen.model.bench.methods import rows_of
from scenegen.model.bench.trials import (
    Measurement,
    draw_trials,
    judge,
    line_blocked,
    met,
    plan_trial,
    risk_of,
)
from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import PlanConfig
from scenegen.truth import distance_field

SEED = 72
SAMPLERS: dict[str, Any] = {"pillar": posterior, "maze": mazes}
RECIPES = {
    kind: replace(preset(kind), flight=replace(preset(kind).flight, viewpoints=1))
    for kind in SAMPLERS
}
GRID = RECIPES["pillar"].grid
METHODS = ("extrude",)
CAREFUL, EDGES = PlanConfig(planner="careful"), PlanConfig(edge_check=True)
COOLING = np.geomspace(0.005, 2.0, 40)
"""Sharpness of the likelihood while a chain is annealed, one after the other."""
NEARLY, TEPID = 25, 0.05
"""With at most so many wrong voxels a chain is annealed again, from this sharpness on."""
ROUNDING, TOUCHED = 60, 3000
"""Voxels by which our rays and solids may differ from the library's, whose documents have six
digits: a return on a voxel's face, a ray that grazes a pillar here and crosses voxels behind it
there; a layer of voxels that a wall touches."""
PROPOSERS, WORLDS = 16, 64
"""Worlds in which paths are planned, and whose distances are averaged."""
ALONE = np.linspace(0.05, 0.8, PROPOSERS)
"""Thresholds of a probability at which paths are planned for a planner that knows nothing else."""
WEIGHT = 5.0
"""Of an occupied voxel when networks learn; their probabilities are higher by it."""
BINS = np.linspace(0, 1, 21)


Planned = tuple[int, dict[str, Measurement], dict[str, float]]
"""The map, and by planner."""


class Options(scoring.Options):
    """How many maps and worlds."""

    root: Positional[Path] = Path("ceiling")
    kind: Literal["pillar", "maze"] = "pillar"
    maps: int = 60
    trials: int = 16
    """goals of each map, whose straight line is blocked"""
    network: tuple[str, ...] = ("anywhere", "columns")
    worlds: int = 512
    """kept of each chain; the first quarter, which may still be like the truth, is not used"""
    steps: int = 10_000
    """between two of them"""
    annealed: int = 12
    """maps for which a second chain begins elsewhere"""
    heating: int = 100_000
    """steps at each sharpness"""
    attempts: int = 8
    """annealed, at most, until one has the scan"""
    part: tuple[int, int] = (0, 1)
    """of so many parts, sample this one"""
    sample_only: bool = False


def main() -> None:
    """Sample what is missing, then write the tables."""
    given = measuring.parse(
        Options, maps=2, trials=1, network=("columns",), worlds=4, steps=50, annealed=1, heating=5
    )
    data = given.root / "data"
    dataset = (
        Dataset(data) if data.exists() else drawn(data, RECIPES[given.kind], given.maps, seed=SEED)
    )
    split = dataset.split("test")
    for number in range(given.part[0], given.maps, given.part[1]):
        for kind in ("truth", "elsewhere")[: 2 if number < given.annealed else 1]:
            file = given.root / f"{kind}-{number:03}.npz"
            if not file.exists():
                begin = time.process_time()
                kept = sampled(split[number], number, kind, given)
                part = file.with_suffix(".part")
                with part.open("wb") as stream:
                    np.savez_compressed(stream, **kept, seconds=time.process_time() - begin)
                part.rename(file)
                print(f"{file.name}: {time.process_time() - begin:.0f} s", file=sys.stderr)
    if not given.sample_only:
        publish(given, [*mixing(split, given), *scores(split, given)])


def true_chain(sample: Sample, number: int, kind: str) -> Any:
    """A chain that begins with a sample's own world; what it sees is what our rays see."""
    recipe, sampler = RECIPES[kind], SAMPLERS[kind]
    prior = sampler.prior_of(recipe.world, recipe.flight.robot_radius_m)
    looked = looked_of(sample)
    for attempt in range(recipe.accept.max_draws):
        rng = UnitKey(SEED, "test", number).rng(WORLD, attempt)
        numbers = sampler.numbers_of(recipe.world, rng)
        chain = sampler.Chain(looked, prior, numbers, number)
        if chain.wrong <= ROUNDING:
            if np.count_nonzero(chain.occupancy() != sample.occupancy) > TOUCHED:
                raise RuntimeError(f"map {number}: the prior draws another world than the recipe")
            return sampler.Chain(replace(looked, state=chain.state()), prior, numbers, number)
    raise RuntimeError(f"map {number}: no draw of the prior is its world")


def looked_of(sample: Sample) -> Looked:
    """What the scan of a sample made known."""
    pose = Pose(sample.position, sample.quaternion)
    marked = sample.observed, sample.free
    return Looked.of(pose, RECIPES["pillar"].lidar, GRID, sample.origin, *marked)


def sampled(sample: Sample, number: int, begin: str, given: Options) -> dict[str, Any]:
    """Worlds that look the same as a sample's. Of pillars, which are equally high, a section is
    kept."""
    chain = true_chain(sample, number, given.kind)
    if begin == "elsewhere":
        chain = annealed(chain, number, given)
    worlds = []
    for _ in range(given.worlds):
        chain.walk(given.steps)
        occupancy = chain.occupancy()
        worlds.append(np.packbits(occupancy.any(axis=2) if is_flat(given) else occupancy))
    names, tried = SAMPLERS[given.kind].MOVES, np.maximum(chain.tried, 1)
    moves = {name: n / of for name, n, of in zip(names, chain.taken, tried, strict=True)}
    kept = {f"taken_{name}": share for name, share in moves.items()}
    return kept | {"worlds": worlds, "wrong": chain.wrong}


def is_flat(given: Options) -> bool:
    """Whether a world is kept as its section."""
    return given.kind == "pillar"


def annealed(chain: Any, number: int, given: Options) -> Any:
    """A chain for the same scan that began with other worlds of the recipe, which slowly became
    worlds with this scan; of several attempts the first that succeeds, or the nearest."""
    sampler, kind, chains = SAMPLERS[given.kind], RECIPES[given.kind].world, list[Any]()
    for attempt in range(given.attempts):
        seed, sharpnesses = [SEED, number, attempt], COOLING
        numbers = sampler.anew(kind, chain.world()[0], np.random.default_rng(seed))
        if chains and chains[0].wrong <= NEARLY:
            (numbers, _), sharpnesses = chains[0].world(), COOLING[COOLING >= TEPID]
        other = sampler.Chain(chain.looked, chain.prior, numbers, seed)
        for sharpness in (*sharpnesses, np.inf):
            other.walk(given.heating, sharpness)
        chains = sorted([*chains, other], key=lambda one: one.wrong)
        if not chains[0].wrong:
            break
    return chains[0]


def worlds_of(given: Options, number: int, sample: Sample, begin: str = "truth") -> Mask:
    """The worlds of a map that are used, (worlds, *grid.shape)."""
    with np.load(given.root / f"{begin}-{number:03}.npz") as kept:
        bits = np.unpackbits(kept["worlds"], axis=1).astype(bool)
    used = bits[len(bits) // 4 :]
    if not is_flat(given):
        return used.reshape(-1, *GRID.shape)
    return used.reshape(-1, *GRID.shape[:2], 1) & solid_layers(sample.origin)


def unknown_in(sample: Sample) -> Mask:
    """The voxels of which the scan says nothing, (*grid.shape)."""
    return np.asarray(~(sample.observed | sample.free))


def solid_layers(origin: Floats) -> Mask:
    """The layers of the map in which pillars are, (Z,)."""
    kind: Any = RECIPES["pillar"].world
    low = origin[2] + GRID.voxel_m * np.arange(GRID.shape[2])
    return np.asarray((low + GRID.voxel_m > 0) & (low < kind.height_m[0]))


def hidden(worlds: Mask, unknown: Mask) -> Floats:
    """Occupied voxels of which the scan knows nothing, (worlds,)."""
    return np.asarray((worlds & unknown).sum(axis=(1, 2, 3)), float)


def mixing(split: Split, given: Options) -> list[str]:
    """How far chains go, whether both kinds of chains agree, and where the truth ranks."""
    ranks, correlations, slow, taken, agreement = [], [], [], [], []
    for number in range(given.maps):
        sample = split[number]
        unknown, worlds = unknown_in(sample), worlds_of(given, number, sample)
        voxels = hidden(worlds, unknown)
        true = hidden(sample.occupancy[None], unknown)[0]
        rng = np.random.default_rng(number)
        ranks.append(rank_in(voxels, true, rng))
        correlations.append(autocorrelation(voxels))
        unsure = np.argwhere(abs(worlds.mean(axis=0) - 0.5) < 0.4)
        for x, y, z in rng.permutation(unsure)[:100]:
            slow.append(autocorrelation(worlds[:, x, y, z].astype(float)))
        with np.load(given.root / f"truth-{number:03}.npz") as kept:
            taken.append([float(kept[f"taken_{name}"]) for name in SAMPLERS[given.kind].MOVES])
        if number < given.annealed:
            with np.load(given.root / f"elsewhere-{number:03}.npz") as kept:
                wrong = int(kept["wrong"])
            other = worlds_of(given, number, sample, "elsewhere")
            difference = np.abs(other.mean(axis=0) - worlds.mean(axis=0))[unknown]
            there = hidden(other, unknown)
            differences = difference.mean(), (difference > 0.1).mean(), there.mean() / voxels.mean()
            agreement.append([number, wrong, *differences, rank_in(there, true, rng)])
    quarters = np.histogram(ranks, bins=4, range=(0, 1))[0]
    rows = [
        (f"accepted: {name}", [f"{share:.3f}"])
        for name, share in zip(SAMPLERS[given.kind].MOVES, np.mean(taken, axis=0), strict=True)
    ]
    rows += [
        (
            "autocorrelation time of hidden voxels, worlds kept",
            [told(correlations, range(len(ranks)), ".2f")],
        ),
        (
            "autocorrelation time of a voxel with a probability of .1 to .9: median, 90 %",
            [" · ".join(f"{time:.1f}" for time in np.quantile(slow or [1.0], (0.5, 0.9)))],
        ),
        ("rank of the truth's hidden voxels, mean", [told(ranks, range(len(ranks)), ".3f")]),
        ("ranks by quarter", [" · ".join(map(str, quarters))]),
    ]
    lines = titled(f"## {given.kind}: mixing", ["value"], rows)
    heads = (
        *("wrong voxels", "mean difference, unknown voxels", "share that differs by more than .1"),
        *("hidden voxels, ratio", "rank of the truth"),
    )
    forms = ".0f", ".4f", ".4f", ".3f", ".3f"
    rows = [
        (str(number), [format(value, form) for value, form in zip(row, forms, strict=True)])
        for number, *row in agreement
    ]
    return lines + titled(f"## {given.kind}: chains that begin elsewhere", heads, rows)


def rank_in(values: Floats, value: float, rng: np.random.Generator) -> float:
    """The share of values that are below this one; those that are equal are above it by chance."""
    return float(np.mean(values < value) + rng.random() * np.mean(values == value))


def autocorrelation(values: Floats) -> float:
    """The integrated autocorrelation time of a series, by Geyer's initial positive sequence."""
    centred = values - values.mean()
    if not centred.any():
        return 1.0
    n = len(values)
    spectrum = np.abs(np.fft.rfft(centred, 2 * n)) ** 2
    covariance = np.fft.irfft(spectrum)[:n] / centred.dot(centred)
    pairs = covariance[: n // 2 * 2].reshape(-1, 2).sum(axis=1)
    stop = int(np.argmax(pairs < 0)) if (pairs < 0).any() else len(pairs)
    return float(max(2 * pairs[:stop].sum() - 1, 1.0))


def ceiling(worlds: Mask) -> Prediction:
    """The best that can be said: the mean of sampled worlds, and of their distances."""
    chance = (worlds.sum(axis=0) + 0.5) / (len(worlds) + 1)
    fields = [distance_field(one, GRID) for one in some(worlds, WORLDS)]
    return Prediction(chance.astype(np.float32), np.mean(fields, axis=0, dtype=np.float32))


def some(worlds: Mask, most: int) -> Mask:
    """Of the worlds of a map, so many at most, spread evenly."""
    return worlds[np.linspace(0, len(worlds) - 1, min(most, len(worlds))).astype(int)]


def scores(split: Split, given: Options) -> list[str]:
    """Tables of reconstruction and of planning."""
    methods = rows_of(METHODS, given.network)
    names = ["ceiling", *(one.name for one in methods)]
    levels = np.arange(1, 100) / 100
    ious, near, doubt, bins, plans = [], [], [], [], []
    for number in range(given.maps):
        sample = split[number]
        worlds = worlds_of(given, number, sample)
        guesses = dict(zip(names, [ceiling(worlds)], strict=False))
        guesses |= {one.name: one.completion(sample, split) for one in methods}
        unknown, true = unknown_in(sample), sample.occupancy
        ious.append([iou_by_level(level_of(one), true, levels) for one in guesses.values()])
        if not number % 2:
            continue
        close = sample.tudf < 0.5
        near.append(
            [rmse(one.distance(None, GRID)[close], sample.tudf[close]) for one in guesses.values()]
        )
        chances = [chance_of(one)[unknown] for one in guesses.values()]
        doubt.append([likelihood(one, true[unknown]) for one in chances])
        bins.append([binned(one, true[unknown]) for one in chances])
        plans += planned(sample, number, worlds, guesses, given)
    chosen = np.mean(ious[::2], axis=0).argmax(axis=1)
    reached = np.array([[of[n] for of, n in zip(one, chosen, strict=True)] for one in ious[1::2]])
    maps = range(len(reached))
    figures = {
        "IoU": reached,
        "Near-RMSE, m": np.array(near),
        "NLL, unknown voxels": np.array(doubt),
    }
    rows = [(what, [told(one, maps, ".4f") for one in of.T]) for what, of in figures.items()]
    rows += [("ECE, unknown voxels", [f"{error(one):.4f}" for one in np.sum(bins, axis=0)])]
    less = [
        (what, [told(one - of.T[0], maps, "+.4f") for one in of.T]) for what, of in figures.items()
    ]
    return (
        titled(f"## {given.kind}: completion", names, rows)
        + titled(f"## {given.kind}: completion, less the ceiling", names, less)
        + planning(plans, given.kind)
    )


def level_of(guess: Prediction) -> Any:
    """What thresholds are compared with."""
    level = guess.occupancy_probability
    return 1 - guess.distance(None, GRID) / 2 if level is None else level


def chance_of(guess: Prediction) -> Any:
    """The probability, calibrated if it can be."""
    return level_of(guess) if guess.probability is None else guess.probability


def iou_by_level(level: Any, true: Mask, levels: Floats) -> Floats:
    """IoU at each threshold, (levels,)."""
    edges = np.concatenate([[-np.inf], levels, [np.inf]])
    inside = np.histogram(level[true], edges)[0][::-1].cumsum()[::-1][1:]
    every = np.histogram(level, edges)[0][::-1].cumsum()[::-1][1:]
    return np.asarray(inside / np.maximum(every + true.sum() - inside, 1))


def rmse(said: Any, true: Any) -> float:
    """The root of the mean squared error."""
    return float(np.sqrt(np.mean((said - true) ** 2)))


def likelihood(chance: Floats, true: Mask) -> float:
    """The mean negative log-likelihood."""
    sure = np.clip(np.where(true, chance, 1 - chance), 1e-7, 1)
    return float(-np.log(sure).mean())


def binned(chance: Floats, true: Mask) -> Floats:
    """Voxels, sums of probabilities and occupied voxels, by bin of probability, (3, bins)."""
    return np.array(
        [np.histogram(chance, BINS, weights=of)[0] for of in (None, chance, 1.0 * true)]
    )


def error(sums: Floats) -> float:
    """The expected calibration error of `binned` sums."""
    count, said, true = sums
    return float(np.abs(said - true).sum() / count.sum())


def planned(
    sample: Sample, number: int, worlds: Mask, guesses: dict[str, Prediction], given: Options
) -> list[Planned]:
    """Trials of a map whose straight line is blocked: what becomes of each planner's path, and with
    which probability it was expected to hit something."""
    grid, truth = GRID, (sample.occupancy, sample.tudf)
    proposers = some(worlds, PROPOSERS)
    fields = [distance_field(one, grid) for one in proposers]
    kind: Any = RECIPES[given.kind].world
    box = np.array([[0, 0, 0], kind.size_m]) - sample.origin
    rng = np.random.default_rng([SEED, number])
    drawn_goals = draw_trials(sample.occupancy, grid, EDGES, count=400, rng=rng, bounds=box).goals
    goals = [one for one in drawn_goals if line_blocked(sample.occupancy, one, grid, EDGES)]
    flat: Any = worlds.reshape(len(worlds), -1)
    chances = {"ceiling, alone": worlds.mean(axis=0, dtype=np.float32)}
    learned = [name for name in guesses if name not in ("ceiling", *METHODS)]
    chances |= {f"{name}, alone": np.asarray(chance_of(guesses[name])) for name in learned}
    alone = {
        name: (
            one.reshape(-1),
            [(one > level, distance_field(one > level, grid)) for level in ALONE],
        )
        for name, one in chances.items()
    }
    chance, found = alone["ceiling, alone"][0], []
    of_truth, best = Prediction(sample.occupancy * 1.0, sample.tudf), guesses["ceiling"]
    odds = WEIGHT * chances["ceiling, alone"]
    weighted = replace(best, occupancy_probability=odds / (1 + odds - odds / WEIGHT))
    for goal in goals[: given.trials]:
        ended: dict[str, Measurement] = {}
        expected: dict[str, float] = {}
        for name, guess in (guesses | {"ceiling, weighted": weighted, "truth": of_truth}).items():
            level = level_of(guess)
            occupied = level > CAREFUL.careful_probability
            risk = risk_of(guess, occupied, sample.observed | sample.free, CAREFUL)
            planned_path = plan_trial(
                occupied, guess.distance(None, grid), risk, goal, grid, CAREFUL
            )
            ended[name] = judge(*planned_path, *truth, grid)
            if name == "ceiling":
                ways = [planned_path]
        ways += [
            plan_trial(one, field, None, goal, grid, EDGES)
            for one, field in zip(proposers, fields, strict=True)
        ]
        risks, paths = risked(ways, chance, grid)
        cells = [met(path, grid) for _, path in paths]
        # the goal is known to be free: trials are drawn so
        at = np.ravel_multi_index(tuple((np.asarray(goal) / grid.voxel_m).astype(int)), grid.shape)
        taken = flat[:, at]
        fits = ~taken | taken.all()
        blocked = np.array([flat[:, of].any(axis=1)[fits].mean() for of in cells])
        choices: dict[str, Any] = {
            "joint": (blocked, risks, paths),
            "marginal": (risks, risks, paths),
        }
        for name, (its_chance, maps) in alone.items():
            ways = [plan_trial(*one, None, goal, grid, EDGES) for one in maps]
            its_risks, its_paths = risked(ways, its_chance, grid)
            choices[name] = its_risks, its_risks, its_paths
        for name, (hits, ties, ways_there) in choices.items():
            if ways_there:
                first = int(np.lexsort((ties, hits))[0])
                plan, path = ways_there[first]
                ended[name] = judge(plan, path, *truth, grid)
                expected[name] = float(hits[first])
        found.append((number, ended, expected))
    return found


def risked(ways: Sequence[Any], chance: Floats, grid: GridSpec) -> tuple[list[float], list[Any]]:
    """Of planned ways, those with a path, and each path's probability of a hit if voxels (voxels,)
    were independent."""
    paths = [way for way in ways if way[1] is not None]
    return [float(1 - np.prod(1 - chance[met(path, grid)])) for _, path in paths], paths


def planning(plans: list[Planned], kind: str) -> list[str]:
    """Success and hits of each planner, and differences of success; intervals over maps."""
    groups = [number for number, _, _ in plans]
    names = sorted({name for _, ended, _ in plans for name in ended})
    none = Measurement(success=False)
    figures = {
        "success": [[float(one.get(name, none).success) for _, one, _ in plans] for name in names],
        "hits": [[float(bool(one.get(name, none).hits)) for _, one, _ in plans] for name in names],
        "hits, expected": [[one.get(name, np.nan) for _, _, one in plans] for name in names],
    }
    rows = [
        (what, [told(one, groups, ".3f") if np.isfinite(one).any() else "–" for one in of])
        for what, of in figures.items()
    ]
    for base in ("marginal", "ceiling, weighted", "ceiling, alone"):
        success = figures["success"]
        against = success[names.index(base)]
        less = [told(np.subtract(one, against), groups, "+.3f") for one in success]
        rows.append((f"success, less {base}", less))
    title = f"## {kind}: planning, {len(plans)} trials whose straight line is blocked"
    return titled(title, names, rows)


if __name__ == "__main__":
    main()
