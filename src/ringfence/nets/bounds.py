"""What a ReLU network can give for all inputs in a set: sound bounds that are linear in the input.

A ReLU whose sign is not known is held between two lines. Bounds of the outputs are then those of a linear function,
which is found by going backward through the layers (CROWN, Zhang et al. 2018). What lines a ReLU gets is decided going
forward, which is cheaper where layers are wide and inputs few.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from ringfence.nets.mlp import MLP
from ringfence.types import Array

ROUNDING = 1e-5  # share of what is summed that single precision may lose


class Inputs(NamedTuple):
    """Inputs center + map δ + ε with |δ| ≤ radius and |ε| ≤ rest, entry by entry."""

    center: Array  # (..., F)
    map: Array | None  # (..., F, P); None: the identity
    radius: Array  # (..., P)
    rest: Array | None = None  # (..., F)


class Lines(NamedTuple):
    """Lines around the ReLUs of a layer: slope z ≤ relu(z) ≤ slope z + rise."""

    slope: Array  # (..., n)
    rise: Array
    below: Array  # slope of the line below that is nearer, 0 or 1 where the sign is not known


class Linear(NamedTuple):
    """Outputs between A x + low and A x + high, for all inputs x of the set."""

    matrix: Array  # (..., M, F)
    low: Array  # (..., M)
    high: Array


def output_bounds(net: MLP, inputs: Inputs) -> tuple[Array, Array]:
    """(..., M) below and above the outputs, of a network that agents share."""
    lines = _lines_of(net, inputs)
    low = _concrete(_below(net, lines, 1.0), inputs)[0]
    high = -_concrete(_below(net, lines, -1.0), inputs)[0]
    return low, high


def lower_bounds(net: MLP, inputs: Inputs) -> Array:
    """(..., M) below the outputs."""
    return _concrete(_below(net, _lines_of(net, inputs), 1.0), inputs)[0]


def linear_bounds(net: MLP, inputs: Inputs) -> Linear:
    """The outputs as linear functions of the inputs, with one matrix for both sides."""
    return _parallel(net, _lines_of(net, inputs))


def _lines_of(net: MLP, inputs: Inputs) -> list[Lines]:
    """Lines around every hidden layer. Sums before ReLUs are followed forward as center + Gδ + ε (zonotopes, Singh et
    al. 2018), where one ε for each unit holds all that lines lose: a matrix product of few rows for each layer."""
    lines: list[Lines] = []
    weight = net.weights[0][0]
    center = inputs.center @ weight + net.biases[0][0]
    if inputs.map is None:
        moved = weight
    else:
        moved = jnp.swapaxes(inputs.map, -1, -2) @ weight  # (..., P, n)
    error = jnp.zeros_like(center) if inputs.rest is None else inputs.rest @ jnp.abs(weight)
    for layer in range(1, len(net.weights)):
        half = (jnp.abs(moved) * inputs.radius[..., None]).sum(-2) + error
        half = half + ROUNDING * (jnp.abs(center) + half + 1.0)
        low, high = center - half, center + half
        unsure = (low < 0) & (high > 0)
        slope = jnp.where(unsure, high / jnp.maximum(high - low, 1e-12), (low >= 0).astype(low.dtype))
        rise = jnp.where(unsure, -low * slope, 0.0)
        below = jnp.where(unsure, (high > -low).astype(low.dtype), slope)
        lines.append(Lines(slope, rise, below))
        weight = net.weights[layer][0]
        center = (slope * center + rise / 2) @ weight + net.biases[layer][0]
        error = (slope * error + rise / 2) @ jnp.abs(weight)
        moved = (moved * slope[..., None, :]) @ weight
    return lines


def _parallel(net: MLP, lines: list[Lines]) -> Linear:
    """The outputs by parallel lines, with one matrix for both sides (Fast-Lin, Weng et al. 2018)."""
    last = len(net.weights) - 1
    matrix = net.weights[last][0].T
    low = high = net.biases[last][0]
    for k in range(last - 1, -1, -1):
        rise = lines[k].rise[..., None, :]
        low = low + (jnp.minimum(matrix, 0.0) * rise).sum(-1)
        high = high + (jnp.maximum(matrix, 0.0) * rise).sum(-1)
        matrix = matrix * lines[k].slope[..., None, :]
        shift = matrix @ net.biases[k][0]
        low = low + shift
        high = high + shift
        matrix = matrix @ net.weights[k][0].T
    if net.linear is not None:
        matrix = matrix + net.linear[0].T
    return Linear(matrix, low, high)


def _below(net: MLP, lines: list[Lines], sign: float) -> Linear:
    """The outputs, times `sign`, from below; a line for each ReLU and output."""
    last = len(net.weights) - 1
    matrix = sign * net.weights[last][0].T
    low = sign * net.biases[last][0]
    for k in range(last - 1, -1, -1):
        low = low + (jnp.minimum(matrix, 0.0) * lines[k].rise[..., None, :]).sum(-1)
        slope, below = lines[k].slope[..., None, :], lines[k].below[..., None, :]
        matrix = matrix * jnp.where(matrix > 0, below, slope)
        low = low + matrix @ net.biases[k][0]
        matrix = matrix @ net.weights[k][0].T
    if net.linear is not None:
        matrix = matrix + sign * net.linear[0].T
    return Linear(matrix, low, low)


def _concrete(bound: Linear, inputs: Inputs) -> tuple[Array, Array]:
    """(..., M) the least and the most that linear functions come to over all inputs."""
    matrix, low, high = bound
    middle = (matrix * inputs.center[..., None, :]).sum(-1)
    of_set = matrix if inputs.map is None else matrix @ inputs.map
    half = (jnp.abs(of_set) * inputs.radius[..., None, :]).sum(-1)
    if inputs.rest is not None:
        half = half + (jnp.abs(matrix) * inputs.rest[..., None, :]).sum(-1)
    half = half + ROUNDING * (jnp.abs(middle) + jnp.abs(low) + jnp.abs(high) + 1.0)
    return middle + low - half, middle + high + half
