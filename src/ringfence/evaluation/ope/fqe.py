"""What a policy is worth by fitted Q evaluation (Le et al. 2019, Batch Policy Learning under Constraints)."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import t as student

from ringfence.evaluation.ope.logs import Logs
from ringfence.nets.mlp import MLP
from ringfence.nets.optim import regress
from ringfence.problem.normalise import varying
from ringfence.types import Array, Key

WIDTH = 64  # units of each of the 2 hidden layers
SLOW = 0.05  # rate at which the copy that targets are read from follows


class Q(eqx.Module):
    """Q of the team, the mean over agents of networks that read an agent's view and action (of a body: everybody's);
    two outputs, return and cost."""

    net: MLP
    joint: bool = eqx.field(static=True)

    def __call__(self, x: Array, action: Array) -> Array:
        if self.joint:
            x, action = x[..., :1, :], action.reshape(*action.shape[:-2], 1, -1)
        return self.net(jnp.concatenate([x, action], -1)).mean(-2)


def worth(
    told: Logs,
    steps: np.ndarray,
    after: np.ndarray,
    starts: np.ndarray,
    first: np.ndarray,
    name: str,
    key: Key,
    members: int,
    updates: int,
    discount: float,
    quiet: bool,
) -> dict[str, dict[str, float]]:
    """Fitted Q evaluation (Le et al. 2019) of discounted return and cost: y = r + γ Q̄(s', a'), where a' is what is
    judged does in s', and Q̄ follows slowly. Each member learns from episodes drawn with replacement."""
    x = np.asarray(told.x)
    flat = x[told.row[steps]].reshape(-1, x.shape[-1]).astype(np.float64)
    mean, scale = flat.mean(0), varying(flat.std(0), flat.mean(0))
    view = lambda rows: jnp.asarray((x[rows] - mean) / scale, jnp.float32)  # noqa: E731
    earned = np.stack([told.rewards[steps], told.costs[steps]], -1).astype(np.float64)
    usual = np.stack([earned.mean(0), np.maximum(earned.std(0), 1e-6)])
    goal = (earned - usual[0]) / usual[1] * (1 - discount)  # so that Q is of the order of 1
    over = told.terminated[steps]
    n, a = after.shape[1:]
    kn, kw, kr = jax.random.split(key, 3)
    sizes = (x.shape[-1] + (n * a if told.joint else a), WIDTH, WIDTH, 2)
    nets = jax.vmap(lambda k: Q(MLP(k, sizes, linear=True), told.joint))(jax.random.split(kn, members))
    episodes, which = np.unique(told.episode[steps], return_inverse=True)
    weight = np.random.default_rng(int(jax.random.bits(kw))).poisson(1.0, (len(episodes), members))[which]
    data = (
        view(told.row[steps]),
        jnp.asarray(told.actions[steps]),
        view(told.row[steps] + 1),
        jnp.asarray(after),
        jnp.asarray(goal, jnp.float32),
        jnp.asarray(~over, jnp.float32),
        jnp.asarray(weight, jnp.float32),
    )

    def loss(both, data, pick: Array) -> Array:
        fast, slow = both
        now, acted, then, next_action, earned, goes_on, weight = (d[pick] for d in data)
        q = jax.vmap(lambda f: f(now, acted))(fast)  # (members, batch, 2)
        ahead = jax.lax.stop_gradient(jax.vmap(lambda f: f(then, next_action))(slow))
        # What ends for good earns nothing more, and nothing is −mean in these units.
        nothing = jnp.asarray(-usual[0] / usual[1], jnp.float32)
        target = earned + discount * jnp.where(goes_on[:, None] > 0, ahead, nothing)
        return (weight.T[..., None] * (q - target) ** 2).mean()

    def follow(both):
        fast, slow = both
        return fast, jax.tree.map(lambda f, s: s + SLOW * (f - s), fast, slow)

    label = "" if quiet else f"what {'the logs are' if name else 'the policy is'} worth"
    fast, _ = regress(loss, (nets, nets), data, len(steps), kr, updates, 256, 1e-3, label, after=follow)
    of = jax.jit(lambda fast, x, a: jax.vmap(lambda f: f(x, a).mean(0))(fast))
    told_of = np.asarray(of(fast, view(starts), jnp.asarray(first)), np.float64)  # (members, 2)
    value = (told_of * usual[1] + usual[0]) / (1 - discount)
    out = {}
    for k, what in enumerate(("return", "cost")):
        half = student.ppf(0.975, members - 1) * value[:, k].std(ddof=1)
        middle = float(value[:, k].mean())
        out[what + name] = {"mean": middle, "low": middle - float(half), "high": middle + float(half)}
    return out
