"""What the actor-critic baselines share: per-agent twin critics, targets, temporal differences, the start of a run.

They learn from single transitions (s̃, a, r_i, s̃'). Agents are independent unless `joint`: Q_i(s̃_i, a_i), each with
its own reward, as in OMAR's study (Pan et al. 2022); with `joint`, Q_i reads everybody's s̃ and a (Lowe et al. 2017).
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ringfence.logs.windows import WindowData, at
from ringfence.nets import MLP
from ringfence.nets.optim import Optimiser, fresh
from ringfence.problem import normalise
from ringfence.proposals.base import Direct
from ringfence.types import Array, Batch, Key, PyTree, Spec


class Critics(eqx.Module):
    """`heads` ReLU networks (s̃_i, a_i) -> R for each of N agents, two hidden layers; G = N·heads, agents outermost.

    The first layer is a sum of a state's and an action's part, so that a state that is paired with many sampled
    actions is read once. Everything is one batched matrix product over G per layer.
    """

    of_state: Array  # (G, D, W)
    of_action: Array  # (G, A, W)
    bias: Array  # (G, 1, W)
    hidden: Array  # (G, W, W)
    hidden_bias: Array  # (G, 1, W)
    out: Array  # (G, W, 1)
    out_bias: Array  # (G, 1, 1)

    def __init__(self, key: Key, agents: int, heads: int, state: int, action: int, width: int):
        ks, ka, kh, ko = jax.random.split(key, 4)
        g = agents * heads
        gain = (2.0 / (state + action)) ** 0.5
        self.of_state = jax.random.normal(ks, (g, state, width)) * gain
        self.of_action = jax.random.normal(ka, (g, action, width)) * gain
        self.bias = jnp.zeros((g, 1, width))
        self.hidden = jax.random.normal(kh, (g, width, width)) * (2.0 / width) ** 0.5
        self.hidden_bias = jnp.zeros((g, 1, width))
        self.out = jax.random.normal(ko, (g, width, 1)) * (1.0 / width) ** 0.5
        self.out_bias = jnp.zeros((g, 1, 1))

    def __call__(self, x: Array, action: Array) -> Array:
        """States (B, N, D), actions (B, N, A) -> (N, heads, B); S actions each, (B, N, S, A) -> (N, heads, B, S)."""
        several = action.ndim == 4
        actions = action if several else action[:, :, None]
        b, n, s, a = actions.shape
        product = jax.lax.batch_matmul
        width = self.hidden.shape[-1]
        heads = len(self.hidden) // n
        states = jnp.repeat(jnp.moveaxis(x, 1, 0), heads, 0)  # (G, B, D)
        actions = jnp.repeat(jnp.moveaxis(actions, 1, 0).reshape(n, b * s, a), heads, 0)
        read = product(states, self.of_state) + self.bias
        y = read[:, :, None] + product(actions, self.of_action).reshape(-1, b, s, width)
        y = product(jax.nn.relu(y).reshape(-1, b * s, width), self.hidden) + self.hidden_bias
        q = product(jax.nn.relu(y), self.out) + self.out_bias
        return q.reshape((n, heads, b, s) if several else (n, heads, b))

    def first(self, agents: int) -> Critics:
        """The first head of every agent alone."""
        return jax.tree.map(lambda w: w[:: len(w) // agents], self)


def in_pieces(step, pieces: int, *arrays: Array):
    """Results of step(*parts) over `pieces` equal parts of the arrays' leading axis, stacked along a new first axis.

    Networks on many sampled actions per state are bound by memory traffic: parts that fit the cache run twice as fast.
    """
    parts = [x.reshape(pieces, -1, *x.shape[1:]) for x in arrays]
    return jax.lax.map(lambda part: step(*part), tuple(parts))


def pieces_of(batch: int, size: int = 32) -> int:
    """How many equal parts of about `size` a batch can be cut into."""
    return next(p for p in range(max(1, batch // size), 0, -1) if batch % p == 0)


class Transitions(eqx.Module):
    """A batch of single steps, standardised states."""

    x: Array  # (B, N, D)
    action: Array  # (B, N, A)
    reward: Array  # (B, N)
    ahead: Array  # (B, N, D)
    bootstrap: Array  # (B, 1): 0 after a terminal state, 1 otherwise; the time limit is no end


def transitions(batch: Batch, norm: normalise.Normaliser) -> Transitions:
    """The present step of each window."""
    x = norm.state(batch.features[:, :2])
    alive = 1.0 - batch.terminated[:, :1].astype(jnp.float32)
    return Transitions(x[:, 0], batch.actions[:, 0], batch.rewards[:, 0], x[:, 1], alive)


def joint(x: Array) -> Array:
    """(B, N, F) -> (B, N, N·F): every agent reads everybody's entries, in the same order."""
    b, n, f = x.shape
    return jnp.broadcast_to(x.reshape(b, 1, n * f), (b, n, n * f))


def joint_actions(action: Array, own: Array) -> Array:
    """(B, N, N·A): for critic i the logged actions, agent i's replaced by `own` (B, N, A), with gradients to own."""
    b, n, a = action.shape
    mine = jnp.eye(n, dtype=bool)[None, :, :, None]
    return jnp.where(mine, own[:, None], action[:, None]).reshape(b, n, n * a)


def start(networks, targets: tuple[str, ...], optimiser: Optimiser, frozen: PyTree) -> PyTree:
    """The state of a run: parameters made by `networks()`, copies of those named in `targets`, moments, step 0."""

    return jax.jit(lambda: fresh(optimiser, networks(), "target", targets))() | {"frozen": frozen}


def make_actor(key: Key, spec: Spec, width: int) -> MLP:
    """One tanh-bounded actor per agent, two hidden layers, starting near the middle of the action range."""
    return MLP(
        key, (spec.feature_dim, width, width, spec.action_dim), groups=spec.n_agents, final_scale=3e-3, acts=spec
    )


def act(actor: MLP, x: Array) -> Array:
    """Actions (B, N, A) in [−1, 1] on standardised states (B, N, D)."""
    return jnp.tanh(actor(x))


def fit_states(data: WindowData | None, spec: Spec, key: Key) -> normalise.Normaliser:
    """Mean and deviation of states; blank without data. It stands for the batch normalisation of OMAR's networks, and
    cloning reads states the same way."""
    if data is None:
        one = jnp.zeros(spec.feature_dim)
        step = jnp.zeros((1, spec.feature_dim))
        return normalise.Normaliser(one, one, step, step, 0, "displacement")
    some = jax.random.randint(key, (min(8192, 4 * data.steps),), 0, data.steps)
    windows = at(data.arrays, some, 2)
    return normalise.fit(np.asarray(windows.features), np.asarray(windows.valid), 0, "displacement")


def no_diagnosis(config, spec, feature_map, hazard):
    """Nothing beyond the metrics of every update."""
    return lambda state, batch, key: {}


def make_policy(state: PyTree, config, spec: Spec, feature_map, hazard, options=None) -> Direct:
    """The deterministic actors; planner options have no meaning here."""
    return Direct(state["params"]["actor"], state["frozen"]["normaliser"], spec, feature_map)
