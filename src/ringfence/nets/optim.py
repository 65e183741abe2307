"""Adam with warm-up, cosine decay and a gradient-norm bound for every network apart."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from ringfence.types import Array, Key, Metrics, PyTree
from ringfence.utils.precision import on_device
from ringfence.utils.progress import Progress

CHUNKS = 40  # a regression is in, one after the other, so that its progress is seen


@dataclass(frozen=True)
class Optimiser:
    """Parameters are a dict of networks; each is clipped by its own norm, so none can silence another."""

    lr: float
    warmup: int  # updates of linear rise
    steps: int  # updates in all; the rate falls along a cosine to `floor`
    clip: float  # bound on the norm; 0: none
    floor: float = 0.1  # share of the rate that is left at the end; 1 keeps it constant

    @classmethod
    def of(cls, config: Any, floor: float = 0.1) -> Optimiser:
        """The one that an algorithm's config asks for; one without `warmup` begins at its full rate."""
        return cls(config.lr, getattr(config, "warmup", 0), config.num_updates, config.grad_clip, floor)

    def _adam(self) -> optax.GradientTransformation:
        warmup = min(self.warmup, max(self.steps // 10, 1))
        last = max(self.steps, warmup + 1)
        rate = optax.warmup_cosine_decay_schedule(0.0, self.lr, warmup, last, self.floor * self.lr)
        bounded = optax.clip_by_global_norm(self.clip) if self.clip > 0 else optax.identity()
        return optax.chain(bounded, optax.adam(rate))

    def init(self, params: dict[str, PyTree]) -> dict[str, PyTree]:
        adam = self._adam()
        return {name: adam.init(p) for name, p in params.items()}

    def update(
        self, grads: dict[str, PyTree], moments: dict[str, PyTree], params: dict[str, PyTree]
    ) -> tuple[dict[str, PyTree], dict[str, PyTree], Metrics]:
        """New parameters, new moments and the gradient norm of every network before clipping."""
        adam = self._adam()
        new = {}
        kept = {}
        norms = {}
        for name, p in params.items():
            step, kept[name] = adam.update(grads[name], moments[name], p)
            new[name] = optax.apply_updates(p, step)
            norms[f"gradient_norm/{name}"] = jnp.sqrt(sum((g**2).sum() for g in jax.tree.leaves(grads[name])))
        return new, kept, norms


def fresh(optimiser: Optimiser, params: dict[str, PyTree], copied_as: str, names: Iterable[str] = ()) -> PyTree:
    """The state of a run at step 0: parameters, copies of those in `names` (all, if none), optimiser moments."""
    copies = {name: jax.tree.map(jnp.copy, params[name]) for name in names or params}
    return {
        "params": params,
        copied_as: copies,
        "opt": optimiser.init(params),
        "step": jnp.zeros((), jnp.int32),
    }


def average(ema: PyTree, params: PyTree, decay: float, step: Array) -> PyTree:
    """Exponential moving average that follows closely at first and settles to `decay`."""
    d = jnp.minimum(decay, (1.0 + step) / (10.0 + step))
    return jax.tree.map(lambda a, p: d * a + (1.0 - d) * p, ema, params)


def follow(slow: PyTree, fast: PyTree, rate: float) -> PyTree:
    """slow + τ (fast − slow), of targets."""
    return jax.tree.map(lambda s, f: s + rate * (f - s), slow, fast)


def stepped(state: PyTree, grads: dict[str, PyTree], optimiser: Optimiser, decay: float) -> tuple[PyTree, Metrics]:
    """The state of a run after a step of all its networks, whose averages follow, and the gradient norms."""
    params, moments, norms = optimiser.update(grads, state["opt"], state["params"])
    ema = average(state["ema"], params, decay, state["step"])
    return {**state, "params": params, "ema": ema, "opt": moments, "step": state["step"] + 1}, norms


def regress(
    loss: Callable[[PyTree, PyTree, Array], Array],
    net: PyTree,
    data: PyTree,
    rows: int,
    key: Key,
    updates: int,
    batch: int,
    rate: float,
    label: str = "",
    decay: float = 0.0,
    after: Callable[[PyTree], PyTree] = lambda net: net,
) -> PyTree:
    """`net` after `updates` steps of Adam on loss(net, data, picked), with `batch` of `rows` row numbers each;
    the rate falls along a cosine to a fiftieth, weights by `decay`. `after` is applied after every update, e.g. to let
    a slow copy follow. Progress is shown under a `label`."""
    adam = optax.adamw(optax.cosine_decay_schedule(rate, updates, 0.02), weight_decay=decay)
    keys = jax.random.split(key, updates)

    @jax.jit
    def advance(carry, data: PyTree, keys: Array, start: int, stop: int):
        def step(i, carry):
            net, moments = carry
            picked = jax.random.randint(keys[i], (batch,), 0, rows)
            moves, moments = adam.update(jax.grad(loss)(net, data, picked), moments, net)
            return after(optax.apply_updates(net, moves)), moments

        return jax.lax.fori_loop(start, stop, step, carry)

    nothing = jax.eval_shape(adam.init, net)  # all that Adam remembers begins at 0: no program for it
    carry = (net, jax.tree.map(lambda leaf: on_device(np.zeros(leaf.shape, leaf.dtype)), nothing))
    chunk = max(1, updates // CHUNKS)
    with Progress(label, updates, quiet=not label) as bar:
        for start in range(0, updates, chunk):
            stop = min(start + chunk, updates)
            carry = jax.block_until_ready(advance(carry, data, keys, start, stop))
            bar.advance(stop - start)
    return carry[0]
