"""Procedural surface patterns, low-pass filtered to the footprint of a pixel so that all views of a surface agree.

Every pattern is a function of surface coordinates in metres and a filter width in periods of the pattern.
Piecewise constant patterns are convolved with a box of that width in closed form (difference of their integral at
both ends); noise drops the octaves that the width cannot resolve.
"""

from __future__ import annotations

import math
from enum import IntEnum

from vg2gt.data.synthetic.raycast import part


class Pattern(IntEnum):
    """Pattern types, as stored in a material."""

    PLAIN = 0
    STRIPES = 1
    CHECKS = 2
    BRICKS = 3
    DOTS = 4
    CLOUDS = 5
    WOOD = 6
    MOSAIC = 7
    _WEAVE = 8
    PLANKS = 9
    WINDOWS = 10


INDOOR = tuple(pattern for pattern in Pattern if pattern is not Pattern.WINDOWS)
PLAIN, STRIPES, CHECKS, BRICKS, DOTS, CLOUDS, WOOD, MOSAIC, _WEAVE, PLANKS, WINDOWS = (int(kind) for kind in Pattern)

_MIN_WIDTH = 1e-4  # filter width below which a pattern counts as unfiltered


@part
def _hash_cell(x, y, seed):
    """Returns a pseudo-random number in [0, 1) for an integer lattice cell."""
    h = (x * 0x27D4EB2D + y * 0x165667B1 + seed * 0x9E3779B1) & 0xFFFFFFFF
    h = ((h ^ (h >> 15)) * 0x2C1B3C6D) & 0xFFFFFFFF
    h = ((h ^ (h >> 12)) * 0x297A2D39) & 0xFFFFFFFF
    return ((h ^ (h >> 15)) & 0xFFFFFF) / 16777216.0


@part
def _blend_cells(x, y, seed, width):
    """Returns a box-filtered random value per unit cell: constant cells with borders ``width`` cells wide."""
    width = min(max(width, _MIN_WIDTH), 1.0)
    x -= 0.5
    y -= 0.5
    ix = math.floor(x)
    iy = math.floor(y)
    u = min(max((x - ix - 0.5) / width + 0.5, 0.0), 1.0)
    v = min(max((y - iy - 0.5) / width + 0.5, 0.0), 1.0)
    i = int(ix)
    j = int(iy)
    low = _hash_cell(i, j, seed) * (1 - u) + _hash_cell(i + 1, j, seed) * u
    high = _hash_cell(i, j + 1, seed) * (1 - u) + _hash_cell(i + 1, j + 1, seed) * u
    return low * (1 - v) + high * v


@part
def _value_noise(x, y, seed):
    """Returns smooth noise in [-1, 1] with unit lattice spacing."""
    ix = math.floor(x)
    iy = math.floor(y)
    u = x - ix
    v = y - iy
    u = u * u * (3 - 2 * u)
    v = v * v * (3 - 2 * v)
    i = int(ix)
    j = int(iy)
    low = _hash_cell(i, j, seed) * (1 - u) + _hash_cell(i + 1, j, seed) * u
    high = _hash_cell(i, j + 1, seed) * (1 - u) + _hash_cell(i + 1, j + 1, seed) * u
    return 2 * (low * (1 - v) + high * v) - 1


@part
def fractal_noise(x, y, frequency, octaves, footprint, seed):
    """Returns a sum of noise octaves, each damped by ``exp(-(frequency * footprint)^2)``; stops below 3 %."""
    total = 0.0
    amplitude = 1.0
    for octave in range(octaves):
        width = frequency * footprint
        damping = math.exp(-width * width)
        if damping < 0.03:
            break
        total += amplitude * damping * _value_noise(x * frequency, y * frequency, seed + octave)
        amplitude *= 0.6
        frequency *= 2.1
    return total


@part
def square_wave(x, width):
    """Returns a box-filtered square wave of period 1: 1 on the first half, 0 on the second."""
    width = max(width, _MIN_WIDTH)
    right = x + 0.5 * width
    left = x - 0.5 * width
    # The wave minus its mean integrates to a triangle wave.
    rise = abs(left - math.floor(left) - 0.5) - abs(right - math.floor(right) - 0.5)
    return 0.5 + 0.5 * rise / width


@part
def pulse_train(x, duty, width):
    """Returns a box-filtered pulse train of period 1: 1 on intervals of length ``duty`` centred at integers, else 0."""
    width = max(width, _MIN_WIDTH)
    right = x + 0.5 * (duty + width)
    left = x + 0.5 * (duty - width)
    until_right = math.floor(right) * duty + min(right - math.floor(right), duty)
    until_left = math.floor(left) * duty + min(left - math.floor(left), duty)
    return (until_right - until_left) / width


@part
def _dots(x, y, width):
    u = x - math.floor(x) - 0.5
    v = y - math.floor(y) - 0.5
    inside = min(max((0.3 - math.sqrt(u * u + v * v)) / max(width, _MIN_WIDTH) + 0.5, 0.0), 1.0)
    fade = min(max(2.0 - 3.0 * width, 0.0), 1.0)  # unresolved dots become their mean coverage
    return inside * fade + 0.2827 * (1 - fade)


@part
def _grain(x, y, frequency, footprint, seed):
    """Returns wood grain along x: lines bent by noise that is stretched along x."""
    bend = fractal_noise(x * 0.3, y * 2.0, frequency, 3, 2.0 * footprint, seed)
    width = 4.0 * frequency * footprint
    lines = math.sin(6.2832 * (2.0 * frequency * y + 0.6 * bend)) * math.exp(-width * width)
    return min(max(0.5 + 0.25 * lines + 0.3 * bend, 0.0), 1.0)


@part
def pattern_value(kind, x, y, frequency, footprint, seed):
    """Evaluates a ``Pattern`` at a surface point: the mixing weight in [0, 1] of a material's two colours.

    Coordinates and the pixel's footprint are in metres, the frequency is in periods per metre.
    """
    width = footprint * frequency
    u = x * frequency
    v = y * frequency
    value = 0.0
    if kind == STRIPES:
        value = square_wave(u, width)
    elif kind == CHECKS:
        a = 2 * square_wave(u, width) - 1
        b = 2 * square_wave(v, width) - 1
        value = 0.5 + 0.5 * a * b
    elif kind == BRICKS:
        row = math.floor(2 * v)
        shifted = u + 0.5 * (row - 2 * math.floor(0.5 * row))
        mortar = 1 - (1 - pulse_train(shifted, 0.05, width)) * (1 - pulse_train(2 * v, 0.1, 2 * width))
        tone = _hash_cell(math.floor(shifted), int(row), seed)
        fade = min(max(2.0 - 4.0 * width, 0.0), 1.0)
        value = (1 - mortar) * (0.5 + fade * 0.8 * (tone - 0.5))
    elif kind == DOTS:
        value = _dots(u, v, width)
    elif kind == CLOUDS:
        value = 0.5 + 0.45 * fractal_noise(x, y, frequency, 5, footprint, seed)
    elif kind == WOOD:
        value = _grain(x, y, frequency, footprint, seed)
    elif kind == MOSAIC:
        value = _blend_cells(u, v, seed, width)
    elif kind == _WEAVE:
        value = 0.5 * pulse_train(u, 0.3, width) + 0.3 * pulse_train(v, 0.3, width)
        value += 0.2 * pulse_train(3 * u + 0.5, 0.15, 3 * width)
    elif kind == PLANKS:
        board = math.floor(v)
        fade = min(max(2.0 - 4.0 * width, 0.0), 1.0)
        tone = _hash_cell(int(board), 7, seed) * fade + 0.5 * (1 - fade)
        grain = _grain(x + 10 * tone, y, frequency * 2.0, footprint, seed)
        value = (1 - pulse_train(v, 0.06, width)) * (0.6 * tone + 0.4 * grain)
    elif kind == WINDOWS:
        pane = pulse_train(u, 0.5, width) * pulse_train(v, 0.55, width)
        bars = 1 - 0.5 * pulse_train(2 * u, 0.08, 2 * width)
        tone = _hash_cell(math.floor(u + 0.5), math.floor(v + 0.5), seed)
        fade = min(max(2.0 - 4.0 * width, 0.0), 1.0)
        value = pane * bars * (0.75 + fade * 0.5 * (tone - 0.5))
    return min(max(value, 0.0), 1.0)
