"""What actions do: an ensemble of forward models, learned from the logs before anything is generated.

Guards check by it where actions really lead, so its errors are what they have to keep in hand. Its members differ in
their first weights and in the order of the steps they see; where they disagree, the logs have not been.

It is fitted long enough to learn contacts: a few thousand updates, which predict free motion well, predict no kick.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from ringfence.nets.mlp import MLP
from ringfence.nets.optim import regress
from ringfence.problem.features import FeatureMap, others
from ringfence.problem.normalise import varying
from ringfence.types import Array, Key

STATES = 20_000  # steps that features and their changes are standardised by
BATCH = 128  # small and often: at equal time it learns contacts that 512 at half the rate does not


class Dynamics(eqx.Module):
    """g_φ of E members. Agents that share a body (`FeatureMap.joint`) have one model of it, which reads everybody's
    action and is told in the first agent's view; otherwise every agent's own entries follow from its own action, and
    the rest from them (`FeatureMap.reconcile`).

    Who hears of nobody (`FeatureMap.guessing`) learns from everybody's view and action, and takes the others' from a
    guess that reads its own view alone. Without that its own action would tell what it cannot see: who brakes in the
    logs often does so because another comes, so that braking would foresee one, and a push that nobody made no one.
    """

    net: MLP  # leaves (E, G, ...)
    guesses: MLP | None  # of what the others see and do, from own features; leaves (E, G, ...)
    mean: Array  # (D,)
    scale: Array  # (D,)
    step_mean: Array  # (F,) of the foreseen entries
    step_scale: Array  # (F,)
    map: FeatureMap = eqx.field(static=True)

    @property
    def foreseen(self) -> np.ndarray:
        """(F,) the entries that the network foresees."""
        return _foreseen(self.map)

    def step(self, before: Array, action: Array) -> tuple[Array, Array]:
        """Features (..., N, D) after actions (..., N, A) in [−1, 1], the mean over members, and how far these are
        apart (..., N): the root mean square over entries of their deviation, in units of a usual step."""
        change = self.changes(before, action)
        spread = jnp.sqrt((change.var(0)).mean(-1) + 1e-12)
        after = self.arrived(before, change.mean(0))
        return after, jnp.broadcast_to(spread, after.shape[:-1])

    def changes(self, before: Array, action: Array) -> Array:
        """(E, ..., N or 1, F) standardised changes of the foreseen entries, by member."""

        def by(net: MLP, guesses: MLP | None) -> Array:
            read = self.read(before, action)
            return net(read if guesses is None else jnp.concatenate([read, self.guessed(guesses, before)], -1))

        return jax.vmap(by)(self.net, self.guesses)

    def read(self, before: Array, action: Array) -> Array:
        """What the network reads, (..., N or 1, D + A or N A), but for what is guessed."""
        if self.map.joint:
            before, action = before[..., :1, :], action.reshape(*action.shape[:-2], 1, -1)
        return jnp.concatenate([(before - self.mean) / self.scale, action], -1)

    def guessed(self, guesses: MLP, before: Array) -> Array:
        """(..., N, (N-1) (D + A)) what each agent takes the others to see and do, standardised."""
        return guesses((before - self.mean) / self.scale)

    def members(self, index: Array) -> tuple[MLP, MLP | None]:
        """The networks of the members at `index` (...), leaves (..., G, ...), for `by_members`."""
        return jax.tree.map(lambda x: x[index], (self.net, self.guesses))

    def by_members(self, nets: tuple[MLP, MLP | None]) -> Dynamics:
        """The same by other members."""
        return replace(self, net=nets[0], guesses=nets[1])

    @property
    def size(self) -> int:
        """E"""
        return self.net.weights[0].shape[0]

    def arrived(self, before: Array, change: Array) -> Array:
        """Features (..., N, D) after a standardised change (..., N or 1, F)."""
        moved = change * self.step_scale + self.step_mean
        if self.map.joint:
            return (before[..., 0, :] + moved[..., 0, :])[..., _of_first(self.map)]
        after = before.at[..., self.foreseen].add(moved)
        if self.map.reconcile is None:
            return after
        return self.map.reconcile(jnp.stack([before, after], -3))[..., 1, :, :]


def fit_dynamics(
    features: Array,
    actions: Array,
    row: Array,
    map: FeatureMap,
    key: Key,
    *,
    members: int,
    updates: int,
    width: int,
    label: str = "",
) -> Dynamics:
    """The ensemble of a data set: features (M, N, D); actions (T, N, A) of the T steps, each from row `row` (T,) to the
    next. The loss is Huber's, in standard deviations of the step: it keeps the kicks of contacts, which dwarf
    everything else, from owning the model."""
    kn, ks, kf = jax.random.split(key, 3)
    blank = blank_dynamics(map, actions.shape[-1], members, width)
    some = row[jax.random.randint(ks, (min(STATES, 4 * len(row)),), 0, len(row))]
    shown = slice(0, 1) if map.joint else slice(None)
    before = np.asarray(features[some, shown], np.float64).reshape(-1, features.shape[-1])
    moved = np.asarray(features[some + 1, shown], np.float64).reshape(before.shape) - before
    mean, scale = before.mean(0), varying(before.std(0), before.mean(0))
    moved, size = moved[:, blank.foreseen], (np.abs(mean) + scale)[blank.foreseen]
    told = dict(mean=mean, scale=scale, step_mean=moved.mean(0), step_scale=varying(moved.std(0), size))
    told = {k: jnp.asarray(v, jnp.float32) for k, v in told.items()}
    model = eqx.tree_at(lambda d: tuple(getattr(d, k) for k in told), blank, tuple(told.values()))
    nets = _networks(kn, map, actions.shape[-1], members, width)
    whose = others(map.plus.shape[0])

    def loss(nets: tuple[MLP, MLP | None], data: tuple[Array, ...], pick: Array) -> Array:
        features, actions, row = data

        def of(nets: tuple[MLP, MLP | None], step: Array) -> Array:
            (net, guesses), action = nets, actions[step]
            before, after = features[row[step]], features[row[step] + 1]
            moved = (after - before)[:, shown, model.foreseen]
            moved = (moved - model.step_mean) / model.step_scale
            read, wrong = model.read(before, action), 0.0
            if guesses is not None:  # it learns from what others saw and did
                theirs = read[:, whose].reshape(*read.shape[:2], -1)
                wrong = ((model.guessed(guesses, before) - theirs) ** 2).mean()
                read = jnp.concatenate([read, theirs], -1)
            return optax.losses.huber_loss(net(read), moved, delta=1.0).mean() + wrong

        return jax.vmap(of)(nets, pick.reshape(members, -1)).sum()

    data = features, actions, row
    return model.by_members(regress(loss, nets, data, len(row), kf, updates, BATCH * members, 4e-3, label))


def blank_dynamics(map: FeatureMap, action: int, members: int, width: int) -> Dynamics:
    """An ensemble of the right shapes that says nothing."""
    one, some = jnp.ones(len(map.names)), jnp.ones(len(_foreseen(map)))
    return Dynamics(*_networks(jax.random.key(0), map, action, members, width), one, one, some, some, map)


def _foreseen(map: FeatureMap) -> np.ndarray:
    everything = map.joint or map.own is None
    return np.arange(len(map.names)) if everything else np.array(map.own)


def _of_first(map: FeatureMap) -> np.ndarray:
    """(N, D) where the first agent's view holds what entry d of agent i is."""
    at = {source: d for d, source in enumerate(map.plus[0].tolist())}
    return np.array([[at[source] for source in row] for row in map.plus.tolist()])


def _networks(key: Key, map: FeatureMap, action: int, members: int, width: int) -> tuple[MLP, MLP | None]:
    """Of what moves, and of what others see and do where that is guessed. Agents of one kind share weights: all of a
    team whose entries are named alike, and the one body of robots."""
    n, entries = map.plus.shape[0], len(map.names)
    read = n * (entries + action) if map.guessing else entries + (n if map.joint else 1) * action
    groups = 1 if map.joint or map.follows else n
    sizes = (read, width, width, len(_foreseen(map)))
    nets = jax.vmap(lambda k: MLP(k, sizes, groups=groups, linear=True))(jax.random.split(key, members))
    if not map.guessing:
        return nets, None
    keys = jax.random.split(jax.random.fold_in(key, 1), members)
    return nets, jax.vmap(lambda k: MLP(k, (entries, width, width, read - entries - action), groups=groups))(keys)
