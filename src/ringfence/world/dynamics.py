"""What actions do: an ensemble of forward models, learned from the logs before anything is generated.

Guards check by it where actions lead, so its errors are what their margins have to cover. Its members differ in their
first weights and in the order of the steps they see. Where they disagree, the state is out of distribution.

It is fitted long enough to learn contacts. A few thousand updates predict free motion well, and no kick.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from ringfence.nets.layers import MLP
from ringfence.nets.optim import regress
from ringfence.problem import partners
from ringfence.problem.features import FeatureMap
from ringfence.problem.motion import pointing, within
from ringfence.problem.normalise import varying
from ringfence.problem.partners import others
from ringfence.types import Array, Key
from ringfence.utils.precision import on_device
from ringfence.world import stops
from ringfence.world.settings import Settings
from ringfence.world.stops import Stop

Seen = tuple[Array, Array]  # (..., N, J) who is seen, and whether that is known
STATES = 20_000  # steps that features and their changes are standardised by
BATCH = 64  # rows of each member: larger ones forecast slightly better, and guard no better


class Dynamics(eqx.Module):
    """g_φ of E members. Agents that share a body (`FeatureMap.joint`) have one model of it, in the first agent's view,
    which reads everybody's action. Otherwise every agent's own entries follow from its own action, and the rest from
    them (`FeatureMap.reconcile`).

    A decentralized agent (`FeatureMap.models_others`) learns from everybody's view and action. It takes the others'
    from a model of them that reads its own view alone. Without that its own action would tell what it cannot see:
    agents brake in the logs because another comes, so that braking would predict one, and a push that nobody made
    would predict none.
    """

    net: MLP  # leaves (E, G, ...)
    guesses: MLP | None  # of what the others see and do, from own features; leaves (E, G, ...)
    mean: Array  # (D,)
    scale: Array  # (D,)
    step_mean: Array  # (F,) of the predicted entries
    step_scale: Array  # (F,) 0 of entries that never change within an episode
    map: FeatureMap = eqx.field(static=True)
    stops: tuple[Stop, ...] = eqx.field(static=True, default=())  # what nobody passes

    @property
    def predicted(self) -> np.ndarray:
        """(F,) the entries that the network predicts."""
        return _predicted(self.map)

    def step(self, before: Array, action: Array) -> tuple[Array, Array]:
        """Features (..., N, D) after actions (..., N, A) in [−1, 1], the mean over members, and how far these are
        apart (..., N): the root mean square over entries of their deviation, in units of a usual step."""
        change = self.changes(before, action)
        # One by one: of a state that is repeated for every member within a loop jax2onnx makes wrong files.
        stopped = jnp.stack([self.stopped(before, of_member) for of_member in change])
        spread = jnp.sqrt(stopped.var(0).mean(-1) + 1e-12)
        after = self.arrived(before, change.mean(0))
        return after, jnp.broadcast_to(spread, after.shape[:-1])

    def changes(self, before: Array, action: Array) -> Array:
        """(E, ..., N or 1, F) standardised changes of the predicted entries, by member."""

        def of_member(net: MLP, guesses: MLP | None) -> Array:
            read = self.read(before, action)
            if guesses is not None:
                read = jnp.concatenate([read, self.guessed(guesses, before)], -1)
            return net(read)

        return jax.vmap(of_member)(self.net, self.guesses)

    def read(self, before: Array, action: Array, seen: Seen | None = None) -> Array:
        """What the network reads, (..., N or 1, D + T + A or N A), but for what is guessed: T angles are two numbers
        each. Where a list of others does not say who they are, their views and actions, too, (..., N, J (D + T + A +
        1)) of those that are known. `seen` says who these are, where that is looked up already."""
        if self.map.joint:
            before = before[..., :1, :]
            action = action.reshape(*action.shape[:-2], 1, -1)
        mine = jnp.concatenate([self._standard(before), action], -1)
        if not self.map.mirrored:
            return mine
        who, known = seen or partners.seen_by(self.map.mirrored, before, self.scale)
        return jnp.concatenate([mine, partners.looked_up(mine, who, known)], -1)

    def _standard(self, before: Array) -> Array:
        """(..., D + T) features as networks read them."""
        return pointing(self.map.turns, before, (before - self.mean) / self.scale)

    def guessed(self, guesses: MLP, before: Array) -> Array:
        """(..., N, (N-1) (D + T + A)) what each agent takes the others to see and do, standardised."""
        return guesses(self._standard(before))

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
        after = self._led(before, change)
        if self.map.joint:
            return within(self.map.turns, after)[..., 0, :][..., _of_first(self.map)]
        if self.map.reconcile is not None:
            after = self.map.reconcile(jnp.stack([before, after], -3))[..., 1, :, :]
        return within(self.map.turns, after)

    def _led(self, before: Array, change: Array) -> Array:
        """Features (..., N or 1, D) whose predicted entries change so, as far as nothing stops them."""
        before = before[..., :1, :] if self.map.joint else before
        moved = change * self.step_scale + self.step_mean
        return stops.saturated(self.stops, self.map, before, before.at[..., self.predicted].add(moved))

    def stopped(self, before: Array, change: Array) -> Array:
        """The standardised change (..., N or 1, F) that is left of one. What goes beyond a stop is no error: networks
        would be slow before it."""
        if not self.stops:
            return change
        before = jnp.broadcast_to(before, (*change.shape[:-2], *before.shape[-2:]))
        moved = self._led(before, change) - (before[..., :1, :] if self.map.joint else before)
        moved = moved[..., self.predicted] - self.step_mean
        return jnp.where(self.step_scale > 0, moved / jnp.maximum(self.step_scale, 1e-30), change)


def fit_dynamics(
    features: Array,
    actions: Array,
    row: Array,
    map: FeatureMap,
    key: Key,
    settings: Settings,
    stops: tuple[Stop, ...] = (),
) -> Dynamics:
    """The ensemble of a data set: features (M, N, D); actions (T, N, A) of the T steps, each from row `row` (T,) to the
    next. The loss is Huber's, in standard deviations of the step: it keeps the kicks of contacts, which dwarf
    everything else, from owning the model."""
    key_nets, key_states, key_fit = jax.random.split(key, 3)
    drawn = jax.random.randint(key_states, (min(STATES, 4 * len(row)),), 0, len(row))
    some = np.asarray(row)[np.asarray(drawn)]
    members = settings.num_ensemble
    shown = slice(0, 1) if map.joint else slice(None)
    states = np.asarray(features)[:, shown]
    before = states[some].reshape(-1, states.shape[-1]).astype(np.float64)
    after = states[some + 1].reshape(before.shape).astype(np.float64)
    shape = map, actions.shape[-1], members, settings.dynamics_width
    model = _standardised(replace(blank_dynamics(*shape), stops=stops), before, after)
    nets = _networks(key_nets, *shape)
    whose = others(map.plus.shape[0])

    def of_member(nets: tuple[MLP, MLP | None], before: Array, action: Array, after: Array, seen: Seen | None) -> Array:
        net, guesses = nets
        moved = map.apart(after, before)[:, shown, model.predicted]
        moved = (moved - model.step_mean) / model.step_scale
        read = model.read(before, action, seen)
        wrong = 0.0
        if guesses is not None:  # it learns from what others saw and did
            theirs = read[:, whose].reshape(*read.shape[:2], -1)
            wrong = ((model.guessed(guesses, before) - theirs) ** 2).mean()
            read = jnp.concatenate([read, theirs], -1)
        change = model.stopped(before, net(read))
        return optax.losses.huber_loss(change, moved, delta=1.0).mean() + wrong

    def loss(nets: tuple[MLP, MLP | None], data: tuple[Array, ...], pick: Array) -> Array:
        features, actions, row, *seen = data

        def of(nets: tuple[MLP, MLP | None], step: Array) -> Array:
            who = (seen[0][row[step]], seen[1][row[step]]) if seen else None
            return of_member(nets, features[row[step]], actions[step], features[row[step] + 1], who)

        return jax.vmap(of)(nets, pick.reshape(members, -1)).sum()

    data = features, actions, row, *(partners.seen_in(map.mirrored, features, model.scale) if map.mirrored else ())
    label = "forward dynamics, what actions do"
    updates = settings.dynamics_updates
    fit = model.by_members(regress(loss, nets, data, len(row), key_fit, updates, BATCH * members, 4e-3, label))
    return _left_alone(fit, before, after, states, np.asarray(row))


def _left_alone(
    model: Dynamics, before: np.ndarray, after: np.ndarray, states: np.ndarray, row: np.ndarray
) -> Dynamics:
    """The model that leaves entries alone which never change in a step from rows (T,) of states (M, N or 1, D), e.g.
    how long a body is; some steps, from `before` to `after` (S, D), tell most others."""
    likely = model.predicted[(before == after).all(0)[model.predicted]]
    still = [d for d in likely.tolist() if np.array_equal(states[row, :, d], states[row + 1, :, d])]
    if not still:
        return model
    zero = np.isin(model.predicted, still)
    each = lambda d: (d.step_mean, d.step_scale)  # noqa: E731
    return eqx.tree_at(each, model, tuple(jnp.where(zero, 0.0, x) for x in each(model)))


def _standardised(model: Dynamics, before: np.ndarray, after: np.ndarray) -> Dynamics:
    """The model with mean and deviation of states (M, D) and of their changes."""
    moved = model.map.apart(after, before)[:, model.predicted]
    mean = before.mean(0)
    scale = varying(before.std(0), mean)
    step_scale = varying(moved.std(0), (np.abs(mean) + scale)[model.predicted])
    statistics = [on_device(x, np.float32) for x in (mean, scale, moved.mean(0), step_scale)]
    return eqx.tree_at(lambda d: (d.mean, d.scale, d.step_mean, d.step_scale), model, statistics)


def blank_dynamics(map: FeatureMap, action: int, num_ensemble: int, width: int) -> Dynamics:
    """An ensemble of the right shapes that says nothing."""
    net, guesses = _networks(jax.random.key(0), map, action, num_ensemble, width)
    one = jnp.ones(len(map.names))
    some = jnp.ones(len(_predicted(map)))
    return Dynamics(net, guesses, mean=one, scale=one, step_mean=some, step_scale=some, map=map)


def _predicted(map: FeatureMap) -> np.ndarray:
    everything = map.joint or map.own is None
    return np.arange(len(map.names)) if everything else np.array(map.own)


def _of_first(map: FeatureMap) -> np.ndarray:
    """(N, D) where the first agent's view holds what entry d of agent i is."""
    at = {source: d for d, source in enumerate(map.plus[0].tolist())}
    return np.array([[at[source] for source in row] for row in map.plus.tolist()])


def _networks(key: Key, map: FeatureMap, action: int, num_ensemble: int, width: int) -> tuple[MLP, MLP | None]:
    """Of what moves, and of what others see and do where that is guessed. Agents of one kind share weights: all of a
    team whose entries are named alike, and the one body of robots."""
    n = map.plus.shape[0]
    entries = len(map.names) + len(map.turns)
    read = n * (entries + action) if map.models_others else entries + (n if map.joint else 1) * action
    read += partners.places(map.mirrored) * (entries + action + 1)
    groups = 1 if map.joint or map.follows else n
    sizes = (read, width, width, len(_predicted(map)))
    keys = jax.random.split(key, num_ensemble)
    nets = jax.vmap(lambda k: MLP(k, sizes, groups=groups, linear=True))(keys)
    if not map.models_others:
        return nets, None
    keys = jax.random.split(jax.random.fold_in(key, 1), num_ensemble)
    sizes = (entries, width, width, read - entries - action)
    return nets, jax.vmap(lambda k: MLP(k, sizes, groups=groups))(keys)
