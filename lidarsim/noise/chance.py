"""Normal numbers and directions of a circle by integers and + - * /, so with the same bits on every
processor, and at a few nanoseconds each.

Each number is made of one word of 64 random bits, and of nothing else: numbers are as independent
of each other as the words are. Where its word alone does not decide, further ones follow from it by
SplitMix64 (Steele, Lea and Flood, "Fast splittable pseudorandom number generators", 2014).
"""

from decimal import Context, Decimal, localcontext
from functools import cache
from typing import Any

import numpy as np
from numpy.random import Generator

from lidarsim.elementary import log_of
from lidarsim.grid import Floats
from lidarsim.jit import kernel

LAYERS = 256
"""Layers of equal area under the bell exp(-x²/2)."""
TAIL = Decimal("3.65415288536100877164542972039951576297")
"""Where the tail begins, which is part of the lowest layer."""
AREA = Decimal("0.00492867323397465534736177540233602807")
"""The area of a layer: 256 of them close the bell at its top, to 38 digits."""
TERMS = 17
"""Of the exponential's series: enough for 2^-60 where a layer is as high as the lowest but one."""
UNIT = 2.0**-53
"""A whole number of 53 bits, times this, lies from 0 to below 1."""
LAYER, SIGN = np.uint64(LAYERS - 1), np.uint64(LAYERS)
"""The bits of a word that choose the layer and the sign; the upper 53 say how far out."""
BELOW = np.uint64(11)
GOLDEN, FIRST, SECOND = (
    np.uint64(0x9E3779B97F4A7C15),
    np.uint64(0xBF58476D1CE4E5B9),
    np.uint64(0x94D049BB133111EB),
)
"""SplitMix64's step, and its factors."""
HALF, LOWER, TWICE = np.uint64(32), np.uint64(2**32 - 1), 2.0**-31
"""Either half of a word as a whole number, and what takes it to a coordinate from -1 to 1."""
SHIFTS = (np.uint64(30), np.uint64(27), np.uint64(31))


def normal(shape: tuple[int, ...], *, rng: Generator) -> Floats:
    """Standard normal numbers of any shape by a ziggurat (Marsaglia and Tsang, "The ziggurat method
    for generating random variables", 2000; with the layer and the place in it from bits of their
    own, as Doornik 2005 asks)."""
    words = _words(shape, rng)
    numbers = words.view(np.float64)  # each in the place of its word
    _normal(words.reshape(-1), *_layers(), numbers.reshape(-1))
    return numbers


def on_circle(shape: tuple[int, ...], *, rng: Generator) -> tuple[Floats, Floats]:
    """Cosine and sine of angles drawn evenly from the whole turn, of any shape: points of a disc,
    whose angle is doubled (von Neumann 1951)."""
    cosine, sine = np.empty(shape), np.empty(shape)
    _on_circle(_words(shape, rng).reshape(-1), cosine.reshape(-1), sine.reshape(-1))
    return cosine, sine


def _words(shape: tuple[int, ...], rng: Generator) -> Any:
    """Words of 64 random bits."""
    return rng.integers(0, 2**64, shape, np.uint64)


@cache
def _layers() -> tuple[Floats, Floats]:
    """How far out the layers reach, from the lowest to the top, and the bell's density there, 257
    each. The lowest is as wide as if its tail were part of a rectangle. Decimal numbers round their
    logarithms right, whatever the processor."""
    with localcontext(Context(prec=38)):
        bell = (-TAIL * TAIL / 2).exp()
        edges, densities = [AREA / bell, TAIL], [Decimal(0), bell]
        while len(edges) < LAYERS:
            densities.append(densities[-1] + AREA / edges[-1])
            edges.append((-2 * densities[-1].ln()).sqrt())
    return np.array([*edges, 0], float), np.array([*densities, 1], float)


@kernel
def _mixed(state):
    """The word of SplitMix64 at a state."""
    word = (state ^ (state >> SHIFTS[0])) * FIRST
    word = (word ^ (word >> SHIFTS[1])) * SECOND
    return word ^ (word >> SHIFTS[2])


@kernel
def _share(word):
    """The upper 53 bits, from 0 to below 1."""
    return np.int64(word >> BELOW) * UNIT


@kernel
def _normal(words, edges, densities, numbers):
    """The number of every word: a place in a layer, at once if it lies below the next one too, else
    if it lies below the bell."""
    for n in range(len(words)):
        word = state = words[n]
        while True:
            layer = np.int64(word & LAYER)
            number = _share(word) * edges[layer]
            if number < edges[layer + 1]:
                break
            if layer == 0:
                number = _beyond(state, edges[1])
                break
            state += GOLDEN
            height = densities[layer + 1] - densities[layer]
            height = densities[layer] + _share(_mixed(state)) * height
            # the bell is exp(rise) times as high here as at the layer's outer edge
            rise, ratio = 0.5 * (edges[layer] - number) * (edges[layer] + number), 1.0
            for m in range(TERMS, 0, -1):
                ratio = 1.0 + ratio * rise / m
            if height < densities[layer] * ratio:
                break
            state += GOLDEN
            word = _mixed(state)
        numbers[n] = -number if word & SIGN else number


@kernel
def _beyond(state, tail):
    """A number of the tail (Marsaglia, "Generating a variable from the tail of the normal
    distribution", 1964)."""
    while True:
        state += GOLDEN
        further = -log_of(1.0 - _share(_mixed(state))) / tail
        state += GOLDEN
        if -2.0 * log_of(1.0 - _share(_mixed(state))) >= further * further:
            return tail + further


@kernel
def _on_circle(words, cosine, sine):
    """Either half of a word is a coordinate in the square around the disc."""
    for n in range(len(words)):
        word = state = words[n]
        while True:
            x = (np.int64(word >> HALF) + 0.5) * TWICE - 1.0
            y = (np.int64(word & LOWER) + 0.5) * TWICE - 1.0
            square = x * x + y * y
            if square <= 1.0:
                break
            state += GOLDEN
            word = _mixed(state)
        cosine[n], sine[n] = (x * x - y * y) / square, 2.0 * x * y / square
