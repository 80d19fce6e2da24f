"""The learning objective is the paper's equations: against them written out in float64, and at
their edges; and their sum has the paper's weights."""

import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from lidarsim import GridSpec
from scenegen import Output
from scenegen.model.config import LossConfig
from scenegen.model.losses import Coupled

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
    """L_eik = 1/sum(m) sum m | |grad| - 1 |, of the voxels that have a next one on every axis."""
    inner, p = np.s_[:, :-1, :-1, :-1], predicted.astype(np.float64)
    steps = [(np.roll(p, -1, axis) - p)[inner] / voxel_m for axis in (1, 2, 3)]
    errors = np.abs(np.sqrt(np.square(steps).sum(axis=0) + 1e-8) - 1)
    counted = ((tudf > 0) & (tudf < np.float32(truncation_m)))[inner]
    return errors[counted].sum() / max(counted.sum(), 1)


def random_case(seed, voxel_m=0.2, truncation_m=2.0):
    """Logits, occupancy, predicted metres and a field with all its shells: 0, voxel * sqrt(k), the
    truncation."""
    rng = np.random.default_rng(seed)
    squares = rng.integers(0, int(1.25 * (truncation_m / voxel_m) ** 2), SHAPE)
    squares[rng.random(SHAPE) < 0.2], squares[rng.random(SHAPE) < 0.2] = 0, 9
    shells = np.minimum(voxel_m * np.sqrt(squares), truncation_m).astype(np.float32)
    logits, noise = rng.normal(0, 4, (2, *SHAPE)).astype(np.float32)
    return logits, rng.random(SHAPE) < 0.3, shells + 0.15 * truncation_m * noise, shells


def value(loss):
    assert loss.shape == ()
    return loss.item()


def term(name, **settings):
    """A part of the objective, and its settings."""
    given = SimpleNamespace(**settings)
    return getattr(Coupled(given, given), name)


def value_and_gradient(loss, at, truth):
    """A loss, and its gradient by what is predicted."""
    at = at.clone().requires_grad_()
    result = loss(at, truth)
    result.backward()
    return value(result), at.grad


SPACE = {"voxel_m": 0.2, "truncation_m": 2.0}
LAWS = [
    ("occupancy_loss", cross_entropy, {"occupied_weight": 5.0}),
    ("occupancy_loss", cross_entropy, {"occupied_weight": 0.3}),
    ("lovasz_loss", lovasz_hinge, {}),
    *[
        ("regression_loss", weighted_smooth_l1, {"near_m": n, "near_weight": w, "beta_m": b})
        for n, w, b in (
            (1.0, 0.25, 2.0),
            (0.0, 3.0, 0.01),
            (0.6, 3.0, 0.7),  # an edge that float32 holds a little beyond the number written
        )
    ],
    ("eikonal_loss", eikonal, SPACE),
    ("eikonal_loss", eikonal, {"voxel_m": 0.13, "truncation_m": 0.9}),
]
"""A loss, its equation, and settings of both."""


def case_of(loss, settings, seed):
    """What is predicted, and what is true."""
    logits, occupancy, *metres = random_case(seed, **settings if loss == "eikonal_loss" else {})
    return (logits, occupancy) if loss in ("occupancy_loss", "lovasz_loss") else metres


@pytest.mark.parametrize(("loss", "equation", "settings"), LAWS)
def test_a_loss_is_the_papers(loss, equation, settings):
    """Of halves, too, which a network under bf16 autocast hands over: they are summed in full."""
    for seed, dtype in itertools.product(range(4), (torch.float32, torch.bfloat16)):
        at, truth = case_of(loss, settings, seed)
        at = torch.from_numpy(at).to(dtype)
        expected = equation(at.float().numpy(), truth, *settings.values())
        actual = term(loss, **settings)(at, torch.from_numpy(truth))
        assert value(actual) == pytest.approx(expected, rel=2e-6)


# Extremes.


@pytest.mark.parametrize("logit", [-1e4, -40.0, 20.0, 300.0])
@pytest.mark.parametrize(("occupied", "weight", "sign"), [(False, 1.0, 1), (True, 5.0, -1)])
def test_logits_of_any_size_have_limits(logit, occupied, weight, sign):
    """Sure and right costs next to nothing, which is not rounded away; sure and wrong by its
    weight."""
    maps = torch.full(SHAPE, logit), torch.full(SHAPE, occupied)
    loss, gradient = value_and_gradient(term("occupancy_loss", occupied_weight=5.0), *maps)
    assert loss == pytest.approx(weight * np.logaddexp(0, sign * logit), rel=1e-5, abs=1e-30)
    assert torch.isfinite(gradient).all()


def test_flat_predictions_have_a_finite_gradient():
    """The root's own slope at 0 is infinite: what stands under it keeps it 1e-4."""
    flat, truth = torch.full(SHAPE, 0.7), torch.ones(SHAPE)
    loss, gradient = value_and_gradient(term("eikonal_loss", **SPACE), flat, truth)
    assert loss == pytest.approx(1 - 1e-4)
    assert_allclose(gradient, 0, atol=1e-12)


def test_nothing_to_learn_is_a_loss_of_zero():
    sloped = torch.full(SHAPE, 2.0)
    sloped[:, -1] = sloped[:, :, -1] = sloped[..., -1] = 1.0  # which have no slope
    for tudf in (torch.zeros(SHAPE), sloped, torch.ones(2, 4, 1, 5)):
        predicted = torch.linspace(0, 9, tudf.numel()).reshape(tudf.shape)
        loss, gradient = value_and_gradient(term("eikonal_loss", **SPACE), predicted, tudf)
        assert (loss, gradient.count_nonzero()) == (0.0, 0)
    assert value(Coupled.lovasz_loss(torch.full(SHAPE, -50.0), torch.zeros(SHAPE).bool())) == 0


@pytest.mark.parametrize(("loss", "equation", "settings"), LAWS[1:])
def test_only_known_voxels_count(loss, equation, settings):
    """The loss is that of the map without the others; a slope needs the next voxel, too."""
    fields = [torch.from_numpy(field) for field in case_of(loss, settings, 5)]
    known = torch.zeros(SHAPE, dtype=torch.bool)
    known[:, : 2 if loss == "eikonal_loss" else 3] = True
    part = term(loss, **settings)(*(field[:, :3] for field in fields))
    assert value(term(loss, **settings)(*fields, known)) == pytest.approx(value(part), rel=1e-6)


# The objective and its weights.


@pytest.mark.parametrize(
    "config",
    [LossConfig(occupancy=0.3, tudf=0.7, eikonal=0.9, lovasz=0.6), LossConfig(tudf=5.0, eikonal=0)],
)
@pytest.mark.parametrize("heads", [("logits", "tudf"), ("logits",), ("tudf",)])
def test_the_objective_is_the_weighted_sum(config, heads):
    """L = l_occ (L_occ + l_lov L_lov) + l_tudf (L_reg + l_eik L_eik), of what the output has."""
    logits, occupancy, predicted, tudf = map(torch.from_numpy, random_case(11))
    objective, weights, terms = Coupled(config, GridSpec()), {}, {}
    if "logits" in heads:
        weights |= {"occupancy": config.occupancy, "lovasz": config.occupancy * config.lovasz}
    if "tudf" in heads:
        weights |= {"regression": config.tudf, "eikonal": config.tudf * config.eikonal}
    for name in filter(weights.get, weights):
        pair = (logits, occupancy) if name in ("occupancy", "lovasz") else (predicted, tudf)
        terms[name] = value(getattr(objective, f"{name}_loss")(*pair))
    expected = terms | {"loss": sum(weights[name] * loss for name, loss in terms.items())}
    output = Output(logits if "logits" in heads else None, predicted if "tudf" in heads else None)
    actual = objective(output, {"occupancy": occupancy, "tudf": tudf})
    assert {name: value(part) for name, part in actual.items()} == pytest.approx(expected)
