"""The paper's joint training (preset `paper`), to be read beside its Algorithm 1: one loss, eq. 8, on generated states,
whose gradient goes both to the barriers ω and to the generator θ.

    L_i^C = Σ_{S0} [δ − h]₊ + Σ_{Sd} [δ + h]₊ + Σ_{Ss} [δ − h(s̃(t+1)) + α h(s̃(t))]₊     on s̃^θ

Two of the three terms send θ the wrong way (docs/method.md); that is what the preset is there to show.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ringfence.nets import MLP
from ringfence.nets.heads import barrier_on
from ringfence.problem.constraints import BoundHazard
from ringfence.problem.normalise import Normaliser
from ringfence.proposals.retention import Retention, mean_over
from ringfence.types import Array, Batch, Metrics


def joint_losses(
    net: MLP, norm: Normaliser, batch: Batch, made: Any, retention: Retention, config: Any, hazard: BoundHazard
) -> tuple[Array, Metrics]:
    """(L^C, metrics) of generated plans `made`, labelled by the formula; on logged windows h is only looked at."""
    now = config.history
    m = config.barrier_batch
    x = made.features[:, now:]
    rows = made.valid[:, now:, None]
    unsafe, safe = hazard.labels(jax.lax.stop_gradient(x))
    terms = retention, made.eta, config.delta, config.scaled_margin
    on_made = hinges(barrier_on(net, norm, x), unsafe, safe, rows, *terms, made.weight)
    loss = on_made.safe + on_made.unsafe + on_made.retention
    data_x = batch.features[:m, now:]
    data_rows = batch.valid[:m, now:, None]
    unsafe, safe = hazard.labels(data_x, batch.costs[:m, now:])
    looked = barrier_on(jax.lax.stop_gradient(net), norm, data_x)
    on_data = hinges(looked, unsafe, safe, data_rows, retention, 0.0, config.delta, config.scaled_margin)
    metrics = {f"barrier/data_{k}": v for k, v in on_data.metrics.items()}
    metrics |= {f"barrier/made_{k}": v for k, v in on_made.metrics.items()}
    return loss, metrics | {"loss/shaping": loss}


class Hinges(NamedTuple):
    """The three conditions as means over their sets; accuracies are the shares that hold with zero margin."""

    safe: Array
    unsafe: Array
    retention: Array
    metrics: Metrics


def hinges(
    h: Array,
    unsafe: Array,
    safe: Array,
    valid: Array,
    retention: Retention,
    eta: Array | float,
    delta: float,
    scaled_margin: bool,
    weight: Array | float = 1.0,
) -> Hinges:
    """The hinges of eq. 8, each a mean over its own set (sums would tie the balance to the batch and its classes).

    h, unsafe, safe, valid: (B, H, N). Sets follow the labels:
        S_0 ∪ S_s:  max(0, δ − h(s̃))              on safe states
        S_d:        max(0, δ + h(s̃))              on unsafe states
        S_s:        max(0, margin − h(s̃_{t+1}) + α h(s̃_t))  on transitions that start in a safe state,
    with margin δ as printed, or (1 − α) δ when scaled. `eta` (B, 1, 1) or a number; `weight` (B, 1, 1).
    """
    margin = (1.0 - retention.m + eta) * delta if scaled_margin else delta
    safe = safe & valid
    unsafe = unsafe & valid
    pair = safe[:, :-1] & valid[:, 1:]
    slack = h[:, 1:] - retention.decay(h[:, :-1], eta)
    return Hinges(
        mean_over(jax.nn.relu(delta - h), safe, weight),
        mean_over(jax.nn.relu(delta + h), unsafe, weight),
        mean_over(jax.nn.relu(margin - slack), pair, weight),
        {
            "accuracy_safe": mean_over(h >= 0, safe),
            "accuracy_unsafe": mean_over(h < 0, unsafe),
            "accuracy_retention": mean_over(slack >= 0, pair),
            "share_unsafe": mean_over(unsafe.astype(jnp.float32), valid),
        },
    )
