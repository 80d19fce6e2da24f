"""Does a network know the classes of what it completes? docs/own-network.md#the-target.

    python benchmarks/semantics.py ROOT    # draws the maps, trains the heads, writes the table

The plan is benchmarks/semantics.md. ROOT gets the maps.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import measuring
import numpy as np
import scoring
import torch
from scipy import ndimage
from scoring import drawn, publish, titled
from torch import Tensor, nn
from torch.nn.functional import one_hot, pad
from tyro.conf import Positional

from lidarsim.grid import GridSpec
from scenegen import Dataset, Sample, preset
from scenegen.model.checkpoint import load_network
from scenegen.model.completion.completer import locate
from scenegen.model.inputs import channels
from scenegen.worlds.kinds import kind_names, training_kinds
from scenegen.worlds.labels import labels_by

SEED = 73
UNSEEN = tuple(kind for kind in kind_names() if kind not in training_kinds())
LABELS = labels_by("class", ())
CLASSES = len(LABELS.classes)
LEVELS = np.arange(1, 20) / 20
"""Thresholds of the probability of occupancy."""
NEAR_M = 2.0
"""Lengths are divided by this one before a head sees them, metres."""


class Options(scoring.Options):
    """How many maps, and how heads are trained."""

    root: Positional[Path] = Path("semantics")
    kinds: Sequence[str] = training_kinds()
    maps: int = 120
    tests: int = 40
    network: tuple[str, ...] = ("anywhere",)
    voxels: int = 2000
    """of a training map"""
    epochs: int = 4
    width: int = 128
    seeds: int = 2
    resamples: int = 2000


class Voxels(NamedTuple):
    """Voxels of one map that a head is asked about, or learns from."""

    cells: Any
    """(channels, cells), float16: the network's features, with a rim of zeros."""
    chosen: Any
    """(voxels, 3): the voxels."""
    place: Any
    """(voxels, 8), float16: place in the cell, nearest return, height."""
    nearest: Any
    """(voxels,): class of the nearest observed voxel."""
    true: Any
    """(voxels,): class."""
    others: Any
    """(classes,): voxels of each class that are not among these."""

    def values(self) -> Tensor:
        """What a head is given, (voxels, inputs), float16: features of the cells around, and the
        place."""
        x, y, z = self.chosen.T // 2
        near = [self.cells[:, x + i, y + j, z + k].T for i, j, k in product(range(3), repeat=3)]
        return torch.cat([*near, self.place], dim=1)


class Head(nn.Module):
    """Inputs (N, inputs) and the nearest class (N,) to logarithms of probabilities (N, classes)."""

    def __init__(self, inputs: int, width: int):
        super().__init__()
        self.own = nn.Sequential(
            nn.Linear(inputs + CLASSES, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(),
            nn.Linear(width, CLASSES),
        )  # fmt: skip
        self.weight = nn.Sequential(nn.Linear(inputs, 32), nn.ReLU(), nn.Linear(32, 1))

    def forward(self, values: Tensor, nearest: Tensor) -> Tensor:
        """See the class."""
        told = one_hot(nearest, CLASSES).float()
        own = self.own(torch.cat([values, told], dim=1)).softmax(dim=1)
        weight = self.weight(values).sigmoid()
        return (weight * told + (1 - weight) * own + 1e-6).log()


def main() -> None:
    """Draw what is missing, train, and write the tables."""
    given = measuring.parse(
        Options, kinds=["pillar", "rooms"], maps=1, tests=2, epochs=1, seeds=1, voxels=50
    )
    torch.set_num_threads(1)
    network, grid, _ = load_network(locate(given.network[0]), frozenset())
    network.eval()
    training = {kind: maps_of(given, kind, "train") for kind in given.kinds}
    tests = {kind: maps_of(given, kind, "test") for kind in (*given.kinds, *UNSEEN)}
    rng = np.random.default_rng(SEED)
    level = threshold(network, grid, training)
    learned = {
        kind: [asked(network, grid, one, level, given.voxels, rng) for one in dataset]
        for kind, dataset in training.items()
    }
    scored = {
        kind: [asked(network, grid, one, level) for one in dataset]
        for kind, dataset in tests.items()
    }
    print(f"threshold {level:.2f}", flush=True)
    found: dict[tuple[str, str, int], Any] = {}
    for seed, out in product(range(given.seeds), ("", *given.kinds)):
        head = trained(
            [one for kind in given.kinds if kind != out for one in learned[kind]], seed, given
        )
        for kind in [out] if out else scored:
            title = "left out" if out else "home" if kind in given.kinds else "unseen"
            found[title, kind, seed] = [confusion(one, guessed(head, one)) for one in scored[kind]]
        print(f"seed {seed}: {out or 'all kinds'}", flush=True)
    base = {kind: [confusion(one, one.nearest) for one in scored[kind]] for kind in scored}
    publish(given, told_all(found, base, given))


def maps_of(given: Options, kind: str, split: Any) -> Sequence[Sample]:
    """The labelled maps of a kind, one a world."""
    folder = given.root / f"{kind}-{split}"
    if not folder.exists():
        recipe = replace(preset(kind), parts={"labels": LABELS})
        count = given.maps if split == "train" else given.tests
        drawn(folder, recipe, count, split=split, seed=SEED, viewpoints=1)
    return Dataset(folder).split(split)


def features(network: Any, grid: GridSpec, sample: Sample) -> tuple[Tensor, Any]:
    """The network's features (channels, cells), and its probability of occupancy (*shape)."""
    batch = channels(network.config.inputs, sample, grid, sample.lidar)
    with torch.inference_mode():
        shared = network.features(
            {name: torch.as_tensor(values)[None] for name, values in batch.items()}
        )["shared"]
        return shared[0], network.head["occupancy"](shared)[0].sigmoid().numpy()


def threshold(network: Any, grid: GridSpec, training: dict[str, Sequence[Sample]]) -> float:
    """The threshold of the best mean IoU on every tenth training map."""
    ious = []
    for sample in [of[n] for of in training.values() for n in range(0, len(of), 10)]:
        chance = features(network, grid, sample)[1]
        masks = [(chance > level) | sample.observed for level in LEVELS]
        ious.append([(m & sample.occupancy).sum() / (m | sample.occupancy).sum() for m in masks])
    return float(LEVELS[np.mean(ious, axis=0).argmax()])


def asked(
    network: Any,
    grid: GridSpec,
    sample: Sample,
    level: float,
    most: int = 0,
    rng: np.random.Generator | None = None,
) -> Voxels:
    """What a head is asked of a map: all voxels that are predicted to be occupied; or, to learn
    from, so many of those among them that are."""
    cells, chance = features(network, grid, sample)
    mask = (chance > level) | sample.observed
    true = np.where(sample.occupancy, np.asarray(sample.voxel_class), 0).astype(np.int64)
    chosen = np.argwhere(mask & (true > 0) if most else mask)
    if rng is not None and len(chosen) > most:
        chosen = chosen[rng.choice(len(chosen), most, replace=False)]
    classes = observed_classes(sample, grid)
    away, where = ndimage.distance_transform_edt(classes == 0, return_indices=True)
    there = tuple(chosen.T)
    nearest = where[(slice(None), *there)].T
    metres = grid.voxel_m / NEAR_M
    height = chosen[:, 2:] * metres + (sample.origin[2] - sample.position[2]) / NEAR_M
    place = [chosen % 2, (nearest - chosen) * metres, away[there][:, None] * metres, height]
    count = np.bincount(true.reshape(-1), minlength=CLASSES)
    said = np.bincount(true[there], minlength=CLASSES)
    return Voxels(
        cells=pad(cells, (1, 1, 1, 1, 1, 1)).half(),
        chosen=chosen,
        place=torch.as_tensor(np.concatenate(place, axis=1)).half(),
        nearest=torch.as_tensor(classes[tuple(nearest.T)]),
        true=torch.as_tensor(true[there]),
        others=count - said,
    )


def observed_classes(sample: Sample, grid: GridSpec) -> Any:
    """The class of each voxel with a return, 0 elsewhere, (*shape), int64."""
    of_returns = np.asarray(sample.return_class)[np.isfinite(sample.ranges)]
    voxels = grid.index(sample.points(), sample.origin)
    inside = np.asarray((voxels >= 0) & (voxels < grid.shape)).all(axis=1)
    classes = np.zeros(grid.shape, np.int64)
    classes[tuple(voxels[inside].T)] = of_returns[inside]
    return classes


def trained(maps: Sequence[Voxels], seed: int, given: Options) -> Head:
    """A head that learned from these maps."""
    torch.manual_seed(seed)
    values = torch.cat([one.values() for one in maps])
    nearest, true = (torch.cat([one[n] for one in maps]) for n in (3, 4))
    head = Head(values.shape[1], given.width)
    optimiser = torch.optim.AdamW(head.parameters(), lr=2e-3)
    for epoch in range(given.epochs):
        for group in optimiser.param_groups:
            group["lr"] = 2e-3 * (1 - epoch / given.epochs)
        for rows in torch.randperm(len(true)).split(4096):
            optimiser.zero_grad()
            said = head(values[rows].float(), nearest[rows])
            loss = nn.functional.nll_loss(said, true[rows])
            loss.backward()
            optimiser.step()
    return head


def guessed(head: Head, one: Voxels) -> Tensor:
    """The class of each voxel by a head, (voxels,)."""
    with torch.inference_mode():
        return head(one.values().float(), one.nearest)[:, 1:].argmax(dim=1) + 1


def confusion(one: Voxels, said: Tensor) -> Any:
    """Voxels of a map by true and predicted class, (classes, classes), without nothing twice."""
    table = np.bincount(np.asarray(one.true * CLASSES + said), minlength=CLASSES**2)
    table = table.reshape(CLASSES, CLASSES)
    table[1:, 0] += one.others[1:]
    return table


def mean_iou(tables: Any) -> Any:
    """mIoU of confusion matrices (..., classes, classes)."""
    hit = np.diagonal(tables, axis1=-2, axis2=-1)[..., 1:]
    true, said = tables.sum(axis=-1)[..., 1:], tables.sum(axis=-2)[..., 1:]
    iou = np.where(true > 0, hit / np.maximum(true + said - hit, 1), np.nan)
    return np.nanmean(iou, axis=-1)


def occupancy_iou(table: Any) -> float:
    """IoU of occupancy of a confusion matrix."""
    return float(table[1:, 1:].sum() / table.sum())


def told_all(found: dict[tuple[str, str, int], Any], base: Any, given: Options) -> list[str]:
    """Tables of each kind, and of the means over kinds."""
    rng, lines = np.random.default_rng(SEED), []
    for title in dict.fromkeys(one for one, _, _ in found):
        kinds = list(dict.fromkeys(kind for one, kind, _ in found if one == title))
        rows, gains = [], []
        for kind in kinds:
            tables = np.array(base[kind])
            heads = [np.array(found[title, kind, seed]) for seed in range(given.seeds)]
            drawn_ = rng.integers(0, len(tables), (given.resamples, len(tables)))
            weights = np.stack([np.bincount(one, minlength=len(tables)) for one in drawn_])
            again = [np.tensordot(weights, one, 1) for one in (tables, *heads)]
            gain = np.mean([mean_iou(one) - mean_iou(again[0]) for one in again[1:]], axis=0)
            plain = [float(mean_iou(one.sum(axis=0))) for one in (tables, *heads)]
            gains.append((np.mean(plain[1:]) - plain[0], gain))
            cells = [f"{occupancy_iou(tables.sum(axis=0)):.3f}", *(f"{one:.3f}" for one in plain)]
            rows.append((f"`{kind}`", [*cells, interval(*gains[-1])]))
        mean = interval(*(np.mean(one, axis=0) for one in zip(*gains, strict=True)))
        rows.append(("mean", [*["–"] * (2 + given.seeds), mean]))
        names = ["occupancy IoU", "`nearest`", *(f"head, seed {n}" for n in range(given.seeds))]
        lines += titled(f"## mIoU, {title}", [*names, "gain"], rows)
    return lines


def interval(value: Any, drawn_values: Any) -> str:
    """A value, and the interval that resamples give it."""
    low, high = np.nanquantile(drawn_values, (0.025, 0.975))
    return f"{value:+.3f} [{low:+.3f}, {high:+.3f}]"


if __name__ == "__main__":
    main()
