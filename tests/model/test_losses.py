"""The learning objective is the paper's equations: against them written out in float64, and at
their edges; and their sum has the paper's weights."""

import dataclasses
import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from lidarsim import GridSpec
from scenegen.model.config import LossConfig
from scenegen.model.losses import Coupled
from scenegen.model.network import Output

SHAPE = (3, 5, 4, 6)  # three maps, no two axes alike

# The equations, one a function, in float64.


def cross_entropy(logits, occupancy, weight):
    """L_occ = -1/N sum w (o log p + (1 - o) log(1 - p)), with log p = -log(1 + exp(-x)) for p of
    logit x."""
    o, x = occupancy.astype(np.float64), logits.astype(np.float64)
    w = np.where(occupancy, weight, 1.0)
    return -(w * (o * -np.logaddexp(0, -x) + (1 - o) * -np.logaddexp(0, x))).sum() / x.size


def lovasz_hinge(logits, occupancy):
    """The mean over maps of the integral over t > 0 of 1 - IoU, where the voxels whose error is t
    or more are wrong."""
    found = []
    for x, o in zip(logits.astype(np.float64), occupancy, strict=True):
        errors = np.maximum(1 - (x - math.log(0.85 / 0.15)) * np.where(o, 1, -1), 0)
        total, below = 0.0, 0.0
        for level in np.unique(errors[errors > 0]):
            said = o ^ (errors >= level)
            total += (level - below) * (1 - (said & o).sum() / (said | o).sum())
            below = level
        found.append(total)
    return float(np.mean(found))


def weighted_smooth_l1(predicted, tudf, near_m, weight, beta_m):
    """L_reg = 1/N sum w SmoothL1(predicted, tudf): e^2 / 2 beta where e < beta, e - beta / 2
    beyond."""
    error = np.abs(predicted.astype(np.float64) - tudf.astype(np.float64))
    smooth = np.where(error < beta_m, error**2 / (2 * beta_m), error - beta_m / 2)
    w = np.where(tudf <= np.float32(near_m), weight, 1.0)
    return (w * smooth).sum() / error.size


def eikonal(predicted, tudf, voxel_m, truncation_m):
    """L_eik = 1/sum(m) sum m | |grad| - 1 |, voxel by voxel."""
    p, total, count = predicted.astype(np.float64), 0.0, 0
    for b, i, j, k in np.ndindex(p.shape[0], *(n - 1 for n in p.shape[1:])):
        if 0 < tudf[b, i, j, k] < np.float32(truncation_m):
            steps = [p[b, i + 1, j, k], p[b, i, j + 1, k], p[b, i, j, k + 1]]
            squares = [((step - p[b, i, j, k]) / voxel_m) ** 2 for step in steps]
            total, count = total + abs(math.sqrt(sum(squares) + 1e-8) - 1), count + 1
    return total / count if count else 0.0


def random_case(seed, shape=SHAPE, voxel_m=0.2, truncation_m=2.0):
    """Logits, occupancy, predicted metres and a field with all its shells: 0, voxel * sqrt(k), the
    truncation."""
    rng = np.random.default_rng(seed)
    reach = math.ceil((truncation_m / voxel_m) ** 2)
    shells = np.minimum(voxel_m * np.sqrt(rng.integers(0, reach * 5 // 4 + 1, shape)), truncation_m)
    shells[rng.random(shape) < 0.2] = 0.0
    shells[rng.random(shape) < 0.2] = voxel_m * min(3, math.floor(truncation_m / voxel_m))
    predicted = shells + rng.normal(0, 0.6 * truncation_m, shape)
    logits = rng.normal(0, 4, shape)
    return (
        logits.astype(np.float32),
        rng.random(shape) < 0.3,
        predicted.astype(np.float32),
        shells.astype(np.float32),
    )


def value(loss):
    assert loss.shape == ()
    return loss.item()


def term(name, **settings):
    """A part of the objective, and its settings."""
    given = SimpleNamespace(**settings)
    return getattr(Coupled(given, given), name)


def gradient(loss, at, truth):
    """Of a loss by what is predicted."""
    tensor = torch.from_numpy(at).requires_grad_()
    loss(tensor, torch.from_numpy(truth)).backward()
    return tensor.grad.numpy()


def finite_differences(equation, at, *more, step=1e-5):
    """Of an equation above, by central differences in float64."""
    out, at = np.empty(at.shape), at.astype(np.float64)
    for index in np.ndindex(at.shape):
        up, down = at.copy(), at.copy()
        up[index] += step
        down[index] -= step
        out[index] = (equation(up, *more) - equation(down, *more)) / (2 * step)
    return out


# Equality with the equations, in value and in gradient.


SPACE = {"voxel_m": 0.2, "truncation_m": 2.0}
SPACES = [SPACE, {"voxel_m": 0.13, "truncation_m": 0.9}]
LAWS = [
    *[("occupancy_loss", cross_entropy, {"occupied_weight": w}) for w in (5.0, 0.3)],
    ("lovasz_loss", lovasz_hinge, {}),
    *[
        ("regression_loss", weighted_smooth_l1, {"near_m": n, "near_weight": w, "beta_m": b})
        for n, w, b in (
            (0.6, 3.0, 0.7),  # an edge that float32 holds a little beyond the number written
            (1.0, 0.25, 2.0),
            (0.0, 3.0, 0.01),
        )
    ],
    *[("eikonal_loss", eikonal, space) for space in SPACES],
]
"""A loss, its equation, and settings of both."""


def case_of(loss, settings, seed, shape=SHAPE):
    """What is predicted, and what is true."""
    space = settings if loss == "eikonal_loss" else {}
    logits, occupancy, predicted, tudf = random_case(seed, shape, **space)
    return (logits, occupancy) if loss in ("occupancy_loss", "lovasz_loss") else (predicted, tudf)


@pytest.mark.parametrize(("loss", "equation", "settings"), LAWS)
def test_a_loss_is_the_papers(loss, equation, settings):
    """Of halves, too, which a network under bf16 autocast hands over: they are summed in full."""
    for seed, dtype in itertools.product(range(4), (torch.float32, torch.bfloat16)):
        at, truth = case_of(loss, settings, seed)
        at = torch.from_numpy(at).to(dtype)
        wanted = equation(at.float().numpy(), truth, *settings.values())
        found = term(loss, **settings)(at, torch.from_numpy(truth))
        assert value(found) == pytest.approx(wanted, rel=2e-6)


@pytest.mark.parametrize(
    ("loss", "equation", "settings"), {law[0]: law for law in reversed(LAWS)}.values()
)
def test_gradients_are_the_finite_differences_of_the_equations(loss, equation, settings):
    for seed in range(3):
        at, truth = case_of(loss, settings, seed, (2, 3, 4, 3))
        wanted = finite_differences(equation, at, truth, *settings.values())
        assert np.abs(wanted).max() > 1e-3
        found = gradient(term(loss, **settings), at, truth)
        assert_allclose(found, wanted, rtol=2e-5, atol=1e-7)


# Extremes.


@pytest.mark.parametrize("logit", [-1e4, -40.0, 20.0, 300.0])
@pytest.mark.parametrize("occupied", [False, True])
def test_logits_of_any_size_have_the_right_limits(logit, occupied):
    """Sure and right costs next to nothing, which is not rounded away; sure and wrong by its
    weight."""
    weight, away = (5.0, -logit) if occupied else (1.0, logit)
    truth = torch.full((1, 4, 3, 2), occupied)
    logits = torch.full(truth.shape, logit).requires_grad_()
    loss = term("occupancy_loss", occupied_weight=5.0)(logits, truth)
    loss.backward()
    assert value(loss) == pytest.approx(weight * np.logaddexp(0, away), rel=1e-5, abs=1e-30)
    assert torch.isfinite(logits.grad).all()


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_a_flat_prediction_has_a_finite_gradient(dtype):
    """The root's own slope at 0 is infinite: what stands under it keeps it 1e-4."""
    predicted = torch.full(SHAPE, 0.7).to(getattr(torch, dtype)).requires_grad_()
    loss = term("eikonal_loss", **SPACE)(predicted, torch.ones(SHAPE))
    loss.backward()
    assert value(loss) == pytest.approx(1 - 1e-4, abs=1e-6)
    assert_allclose(predicted.grad.float().numpy(), 0, atol=1e-12)


def test_where_nothing_is_to_be_learned_the_loss_is_zero_and_so_is_its_gradient():
    shape = (2, 4, 3, 5)
    last = torch.full(shape, 2.0)  # which have no slope
    last[:, -1], last[:, :, -1], last[..., -1] = 1.0, 1.0, 1.0
    fields = [torch.zeros(shape), last, torch.ones(2, 4, 1, 5)]
    for tudf in fields:
        predicted = torch.from_numpy(random_case(0, tuple(tudf.shape))[2]).requires_grad_()
        loss = term("eikonal_loss", **SPACE)(predicted, tudf)
        loss.backward()
        assert value(loss) == 0.0
        assert_array_equal(predicted.grad.numpy(), 0)
    nothing = torch.zeros(1, 2, 3, 4, dtype=torch.bool)
    assert value(Coupled.lovasz_loss(torch.full(nothing.shape, -50.0), nothing)) == 0


def test_a_loss_over_what_is_known_is_that_of_the_map_without_the_rest(rng):
    occupancy = torch.from_numpy(rng.random(SHAPE) < 0.3)
    logits, predicted, tudf = (
        torch.from_numpy(rng.normal(1, 1, SHAPE).astype(np.float32)) for _ in range(3)
    )
    known = torch.zeros(SHAPE, dtype=torch.bool)
    known[:, :3] = True
    slopes = known.clone()
    slopes[:, 2] = False  # a slope needs the next voxel
    metres = {"near_m": 0.5, "near_weight": 2.0, "beta_m": 0.3}
    for name, given, over, settings in (
        ("occupancy_loss", (logits, occupancy), known, {"occupied_weight": 3.0}),
        ("lovasz_loss", (logits, occupancy), known, {}),
        ("regression_loss", (predicted, tudf), known, metres),
        ("eikonal_loss", (predicted, tudf), slopes, SPACE),
    ):
        loss = term(name, **settings)
        part = loss(*(field[:, :3] for field in given))
        assert value(loss(*given, over)) == pytest.approx(value(part), rel=1e-6)


# The objective and its weights.

CONFIGS = [
    LossConfig(),
    LossConfig(
        **{"occupancy": 0.3, "tudf": 0.7, "eikonal": 0.9, "lovasz": 0.6, "occupied_weight": 3},
        **{"near_weight": 4, "near_m": 0.8, "beta_m": 0.2},
    ),
    LossConfig(tudf=5.0, eikonal=0.0),
]


@pytest.mark.parametrize("config", CONFIGS)
@pytest.mark.parametrize("heads", ["both", "logits", "tudf"])
def test_the_objective_is_the_weighted_sum(config, heads):
    """L = l_occ L_occ + l_tudf (L_reg + l_eik L_eik), of what the output has."""
    space = SPACES[1]
    logits, occupancy, predicted, tudf = random_case(11, **space)
    output = Output(
        logits=None if heads == "tudf" else torch.from_numpy(logits),
        tudf=None if heads == "logits" else torch.from_numpy(predicted),
    )
    wanted, loss = {}, 0.0
    if output.logits is not None:
        wanted["occupancy"] = cross_entropy(logits, occupancy, config.occupied_weight)
        if config.lovasz:
            wanted["lovasz"] = lovasz_hinge(logits, occupancy)
        loss += config.occupancy * (wanted["occupancy"] + config.lovasz * wanted.get("lovasz", 0))
    if output.tudf is not None:
        near = (config.near_m, config.near_weight, config.beta_m)
        wanted["regression"] = weighted_smooth_l1(predicted, tudf, *near)
        if config.eikonal:
            wanted["eikonal"] = eikonal(predicted, tudf, **space)
        slope = config.eikonal * wanted.get("eikonal", 0)
        loss += config.tudf * (wanted["regression"] + slope)
    batch = {"occupancy": torch.from_numpy(occupancy), "tudf": torch.from_numpy(tudf)}
    found = Coupled(config, GridSpec(**space))(output, batch)
    assert {name: value(part) for name, part in found.items()} == pytest.approx(
        {**wanted, "loss": loss}, rel=1e-6
    )


def test_the_default_weights_are_the_papers():
    papers = {"occupancy": 0.1, "tudf": 1.0, "eikonal": 0.05}
    papers |= {"occupied_weight": 5, "near_weight": 2, "near_m": 0.5}
    ours = {"beta_m": 1.0, "lovasz": 0.0, "objective": "coupled"}
    assert dataclasses.asdict(LossConfig()) == papers | ours
