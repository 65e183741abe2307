"""A plan is proved where all that the World predicts of it is safe, from all states that observations allow.

Observations may be off by ε in every entry, and old: others may have accelerated since. From that box of states the
World's dynamics lead to another, row by row, and the least score in each is bounded from below. An
action is proved if that is 0 or more in every row of a plan that begins with it: some way out is left. This says
nothing of a World that errs by more than `residual` a row, nor of others who do not keep their velocity meanwhile.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ringfence.errors import UserError
from ringfence.guards.correction import directions
from ringfence.nets.layers import MLP
from ringfence.problem.features import FeatureMap, motion_rules, others_offsets
from ringfence.types import Array
from ringfence.world import World
from ringfence.world.barrier import Barrier, soft
from ringfence.world.cause_nets import CauseNet, Distance, Score
from ringfence.world.dynamics import Dynamics
from ringfence.world.stops import UNLIMITED, Heading, Saturation

EXACT = ("seen",)  # entries that are no measurements, by the ends of their names
ROUNDING = 1e-5  # share of what is summed that single precision may lose


class Box(NamedTuple):
    """States (..., N, D) within a distance of a center, entry by entry."""

    center: Array
    radius: Array


def _ends_of(begun: Box, change: Box) -> tuple[Array, Array]:
    """(least, most) that is within one box and a change of it."""
    center, radius = begun.center + change.center, begun.radius + change.radius
    return center - radius, center + radius


def _widened(box: Box, low: Array, high: Array) -> Box:
    """The box, of what has between `low` (0 or less) and `high` (0 or more) added to it."""
    return Box(box.center + (low + high) / 2, box.radius + (high - low) / 2)


class Motion(NamedTuple):
    """How entries of a view follow from the own velocity: index arrays."""

    own: np.ndarray  # (F,) predicted entries
    place: np.ndarray  # (P,) entries of places,
    speed: np.ndarray  # (P,) of their relative velocities, −1 of what stands still,
    mine: np.ndarray  # (P,) and which of `own` moves oneself along that axis
    others: np.ndarray  # (P,) bool: of somebody who may accelerate


class Prover(eqx.Module):
    """Proves plans of a World in which agents see for themselves and others keep their velocity."""

    world: World
    epsilon: float = eqx.field(static=True)  # that an observed entry may be off by, in its own unit
    acceleration: float = eqx.field(static=True)  # m/s² of others since they were seen
    rows: int = eqx.field(static=True)  # that are proved
    residual: float = eqx.field(static=True, default=0.0)  # by which a row of the own velocity may err

    def __check_init__(self):
        barrier = self.world.barrier
        shared = all(len(net.weights[0]) == 1 for net in ([] if barrier is None else _networks(barrier)))
        known = isinstance(barrier, Barrier) and not barrier.shape.use_transition and not barrier.shape.joint
        dynamics = self.world.dynamics
        linear = dynamics.guesses is None and Heading.of(dynamics.map.names) is None and not dynamics.map.turns
        if self.world.map.dt is None or not known or not shared or not linear:
            raise UserError(
                "proof is of Worlds of homogeneous agents without a heading or angles, whose danger is one and of "
                "states, and this World is another; leave proof out."
            )

    def continued(self, present: Array, plan: Array) -> Array:
        """(B, rows, N, A) what begins with the first action of plans (B, K, N, A), and scores best by prediction: the
        plan and braking after it, braking at once, or pushing in one direction. Each agent has its own."""
        first = plan[:, :1]
        pushes = jnp.asarray(directions(plan.shape[-1]), plan.dtype)
        shape = (len(plan), len(pushes), self.rows - 1, *plan.shape[2:])
        pushed = jnp.broadcast_to(pushes[None, :, None, None], shape)
        pushed = jnp.concatenate([jnp.broadcast_to(first[:, None], (*shape[:2], 1, *shape[3:])), pushed], 2)
        braked = jnp.stack([self.braked(present, plan), self.braked(present, first)], 1)
        found = jnp.concatenate([braked, pushed], 1)  # (B, S, rows, N, A)
        best = self._predicted(present, found).argmax(1)
        return jnp.take_along_axis(found, best[:, None, None, :, None], 1)[:, 0]

    def _predicted(self, present: Array, plans: Array) -> Array:
        """(B, S, N) the least score along plans (B, S, K, N, A), as predicted from the middle of the box."""
        barrier = self.world.barrier
        assert isinstance(barrier, Barrier), "checked when it was made"
        before = jnp.broadcast_to(present[:, None], (*plans.shape[:2], *present.shape[1:]))

        def step(carry: tuple[Array, Array], action: Array) -> tuple[tuple[Array, Array], None]:
            x, lowest = carry
            after, _ = self.world.dynamics.step(x, action)
            return (after, jnp.minimum(lowest, barrier.of_steps(x, after))), None

        begun = before, jnp.full(before.shape[:-1], jnp.inf)
        (_, lowest), _ = jax.lax.scan(step, begun, jnp.moveaxis(plans, 2, 0))
        return lowest

    def lower_bounds(self, present: Array, plan: Array, unseen: Array | None = None) -> Array:
        """(B, K, N) below the least score, in margins, of the rows after every action of plans (B, K, N, A)."""
        boxes = self.reached(present, plan, unseen)
        barrier = self.world.barrier
        assert isinstance(barrier, Barrier), "checked when it was made"
        below = soft(score_below(barrier, boxes)) / barrier.unit
        return below - ROUNDING * (jnp.abs(below) + 1.0)  # far from danger scores hardly rise, and bounds come close

    def braked(self, present: Array, plan: Array) -> Array:
        """Plans (B, K, N, A) and braking after them, `rows` in all; as predicted from the middle of the box."""
        dynamics = self.world.dynamics
        motion = motion_of(dynamics.map)
        wanted = jnp.concatenate(
            [plan, jnp.zeros((plan.shape[0], max(self.rows - plan.shape[1], 0), *plan.shape[2:]))], 1
        )
        follows = jnp.arange(self.rows) < plan.shape[1]

        def step(x: Array, given: tuple[Array, Array]) -> tuple[Array, Array]:
            asked, as_asked = given
            action = jnp.where(as_asked, asked, _braking(dynamics, motion, x))
            return dynamics.step(x, action)[0], action

        _, actions = jax.lax.scan(step, present, (jnp.moveaxis(wanted[:, : self.rows], 1, 0), follows))
        return jnp.moveaxis(actions, 0, 1)

    def reached(self, present: Array, plan: Array, unseen: Array | None = None) -> Box:
        """Boxes (B, K, N, D) that hold the rows after every action, from all states that are possible now."""
        dynamics = self.world.dynamics
        motion = motion_of(dynamics.map)
        spread = self._possible(present, unseen)
        shape = (*present.shape[:-1], len(motion.own))
        nothing = Box(jnp.zeros(shape), jnp.zeros(shape))

        def step(carry: tuple[Box, Box, Box], given: tuple[Array, Array]) -> tuple[tuple[Box, Box, Box], Box]:
            now, change, gone = carry
            action, row = given
            later = self._changed(now, change, spread[..., motion.own], action)
            late = dynamics.map.late
            gone = Box(
                gone.center + late * later.center + (1 - late) * change.center,
                gone.radius + late * later.radius + (1 - late) * change.radius,
            )
            now = self._row(Box(present, spread), later, gone, row)
            return (now, later, gone), now

        given = jnp.moveaxis(plan, 1, 0), jnp.arange(1.0, plan.shape[1] + 1)
        _, boxes = jax.lax.scan(step, (Box(present, spread), nothing, nothing), given)
        return Box(*(jnp.moveaxis(x, 0, 1) for x in boxes))

    def _possible(self, present: Array, unseen: Array | None) -> Array:
        """(B, N, D) how far each entry may be from what is observed, by others who were not seen for so many steps."""
        map = self.world.map
        motion = motion_of(map)
        exact = np.array([name.endswith(EXACT) for name in map.names])
        spread = jnp.broadcast_to(jnp.where(exact, 0.0, self.epsilon), present.shape)
        if unseen is None or not self.acceleration:
            return spread
        assert map.dt is not None, "checked when it was made"
        since = unseen[..., None] * map.dt
        spread = spread.at[..., motion.place[motion.others]].add(0.5 * self.acceleration * since**2)
        return spread.at[..., motion.speed[motion.others]].add(self.acceleration * since)

    def _row(self, first: Box, change: Box, gone: Box, row: Array) -> Box:
        """Where all is, given the changes of the own velocity since, and their sum over the rows."""
        map = self.world.map
        motion = motion_of(map)
        dt = map.dt or 0.0
        center = first.center.at[..., motion.own].add(change.center)
        radius = first.radius.at[..., motion.own].add(change.radius)
        mine = motion.mine
        moves = motion.speed >= 0
        drift = jnp.where(moves, first.center[..., motion.speed], -first.center[..., motion.own][..., mine])
        unsure = jnp.where(moves, first.radius[..., motion.speed], first.radius[..., motion.own][..., mine])
        center = center.at[..., motion.place].add(dt * (row * drift - gone.center[..., mine]))
        radius = radius.at[..., motion.place].add(dt * (row * unsure + gone.radius[..., mine]))
        speeds = motion.speed[moves]
        center = center.at[..., speeds].add(-change.center[..., mine[moves]])
        radius = radius.at[..., speeds].add(change.radius[..., mine[moves]])
        return Box(center, radius + ROUNDING * (jnp.abs(center) + 1.0))

    def _changed(self, now: Box, change: Box, own_spread: Array, action: Array) -> Box:
        """The change of the own velocity since the beginning, one row later. What the network takes off a velocity that
        changed is taken off that change, so both are bounded together."""
        dynamics = self.world.dynamics
        motion = motion_of(dynamics.map)
        center = jnp.concatenate([(now.center - dynamics.mean) / dynamics.scale, action], -1)
        radius = jnp.concatenate([now.radius / dynamics.scale, jnp.zeros_like(action)], -1)
        of_members = jax.vmap(lambda net: linear_bounds(net, Inputs(center, None, radius)))(dynamics.net)
        matrix, low, high = (x.mean(0) for x in of_members)
        low = low * dynamics.step_scale + dynamics.step_mean
        high = high * dynamics.step_scale + dynamics.step_mean
        matrix = matrix * dynamics.step_scale[:, None]
        middle = (matrix * center[..., None, :]).sum(-1) + (low + high) / 2
        slope = matrix[..., motion.own] / dynamics.scale[motion.own]  # (..., F, F) by the own velocity
        rest = radius.at[..., motion.own].set(0.0)
        half = (jnp.abs(matrix) * rest[..., None, :]).sum(-1) + (high - low) / 2
        half = half + (jnp.abs(slope) * own_spread[..., None, :]).sum(-1)
        both = jnp.abs(jnp.eye(len(motion.own)) + slope)
        half = half + (both * change.radius[..., None, :]).sum(-1) + self.residual
        begun = Box(now.center[..., motion.own] - change.center, own_spread)
        later = self._stopped(begun, Box(middle + change.center, half))
        return Box(later.center, later.radius + ROUNDING * (jnp.abs(later.center) + 1.0))

    def _stopped(self, begun: Box, change: Box) -> Box:
        """The change of an own velocity, which was within `begun`, as stops leave it."""
        dynamics = self.world.dynamics
        own = motion_of(dynamics.map).own
        low, high, fastest = Saturation.of(dynamics.stops, dynamics.map, 1)  # of homogeneous agents
        low, high = low[0, own], high[0, own]
        if np.isfinite(low).any() or np.isfinite(high).any():
            least, most = _ends_of(begun, change)
            change = _widened(change, jnp.minimum(high - most, 0.0), jnp.maximum(low - least, 0.0))
        if fastest[0] < UNLIMITED:
            least, most = _ends_of(begun, change)
            size = jnp.sqrt((jnp.maximum(-least, most) ** 2).sum(-1, keepdims=True))
            slower = 1.0 - fastest[0] / jnp.maximum(size, fastest[0])  # the share that is lost, at most
            change = _widened(change, -slower * jnp.maximum(most, 0.0), -slower * jnp.minimum(least, 0.0))
        return change


def motion_of(map: FeatureMap) -> Motion:
    """The entries of a view by how they move."""
    rules = motion_rules(map.names)
    own = np.array(map.own, int)
    place, speed, mine = (np.array(column, int) for column in zip(*rules))
    moving = set(others_offsets(map.names).ravel().tolist())
    at = {entry: k for k, entry in enumerate(own.tolist())}
    others = np.array([entry in moving and along >= 0 for entry, along in zip(place, speed)])
    return Motion(own, place, speed, np.array([at[entry] for entry in mine]), others)


def score_below(barrier: Barrier, boxes: Box) -> Array:
    """(...,) below ℓ, before it is bounded softly, of all states in boxes (..., D)."""
    if barrier.causes:
        return jnp.concatenate([_cause_below(score, boxes) for score in barrier.causes], -1).min(-1)
    shape = barrier.shape
    center = (boxes.center - barrier.mean) / barrier.scale
    radius = boxes.radius / barrier.scale
    parts: list[Array] = []
    if "own" in barrier.label:
        own = np.array(shape.own)
        parts.append(lower_bounds(barrier.label["own"], Inputs(center[..., own], None, radius[..., own])))
    for (kind, entries), (place, speed) in zip(shape.pairs, shape.offsets):
        index = np.array(entries)
        pair = _pair_inputs(center[..., index], radius[..., index], place, speed)
        parts.append(lower_bounds(barrier.label[kind], pair)[..., 0])
    return jnp.concatenate(parts, -1).min(-1)


def _networks(barrier: object) -> list:
    if not isinstance(barrier, Barrier):
        return []
    return [*barrier.label.values(), *(s.net for s in barrier.causes if isinstance(s, CauseNet))]


def _pair_inputs(center: Array, radius: Array, place: tuple[int, ...], speed: tuple[int, ...]) -> Inputs:
    """What a network of pairs reads, distance and parting speed included, for pairs in boxes (..., F): these two by
    their slope in the middle, and by how far they can be from that."""
    if not place:
        return Inputs(center, None, radius)
    where, fast = list(place), list(speed)
    offset, offset_radius = center[..., where], radius[..., where]
    distance = jnp.sqrt((offset**2).sum(-1) + 1e-9)
    toward = offset / distance[..., None]
    low, high = _length_bounds(offset, offset_radius)
    above = _most_above(offset, offset_radius, distance, toward)
    rows = [jnp.zeros_like(center).at[..., np.array(where)].set(toward)]
    middle = [distance + above / 2]
    rest = [above / 2]
    if speed:
        velocity, velocity_radius = center[..., fast], radius[..., fast]
        parting = (toward * velocity).sum(-1)
        by_place = (velocity - toward * parting[..., None]) / distance[..., None]
        rows.append(rows[0] * 0.0)
        rows[1] = rows[1].at[..., np.array(where)].set(by_place).at[..., np.array(fast)].set(toward)
        middle.append(parting)
        most = jnp.sqrt(((jnp.abs(velocity) + velocity_radius) ** 2).sum(-1))
        moved = jnp.sqrt((offset_radius**2).sum(-1))
        faster = jnp.sqrt((velocity_radius**2).sum(-1))
        near = jnp.maximum(low, 1e-6)
        curved = 0.6 * most * (moved / near) ** 2 + moved * faster / near  # Taylor's remainder
        linear = jnp.abs(parting) + (jnp.abs(by_place) * offset_radius + jnp.abs(toward) * velocity_radius).sum(-1)
        rest.append(jnp.minimum(curved, most + linear))
    size = center.shape[-1]
    map = jnp.concatenate([jnp.broadcast_to(jnp.eye(size), (*center.shape, size)), jnp.stack(rows, -2)], -2)
    rest_of_all = jnp.concatenate(
        [jnp.zeros_like(center), jnp.stack(rest, -1) + ROUNDING * (1.0 + high[..., None])], -1
    )
    return Inputs(jnp.concatenate([center, jnp.stack(middle, -1)], -1), map, radius, rest_of_all)


def _length_bounds(offset: Array, radius: Array) -> tuple[Array, Array]:
    """The least and the most length of vectors (..., 2 or 3) within a radius of each entry."""
    low = jnp.sqrt((jnp.maximum(jnp.abs(offset) - radius, 0.0) ** 2).sum(-1))
    high = jnp.sqrt(((jnp.abs(offset) + radius) ** 2).sum(-1) + 1e-9)
    return low, high


def _most_above(offset: Array, radius: Array, length: Array, slope: Array) -> Array:
    """By how much a length exceeds its tangent in the middle of a box, at most: it is convex, so at a corner."""
    found = jnp.zeros_like(length)
    for signs in np.ndindex(*(2,) * offset.shape[-1]):
        corner = radius * (2.0 * np.array(signs) - 1.0)
        there = jnp.sqrt(((offset + corner) ** 2).sum(-1) + 1e-9)
        found = jnp.maximum(found, there - length - (slope * corner).sum(-1))
    return found


def _cause_below(score: Score, boxes: Box) -> Array:
    """(..., J) below the score of a cause."""
    cause = score.cause
    low, high = cause.between(boxes.center - boxes.radius, boxes.center + boxes.radius)
    center = (low + high) / 2
    radius = (high - low) / 2 + ROUNDING * (1.0 + jnp.abs(center))
    gain = jnp.exp(score.log_gain)
    if isinstance(score, Distance):  # its slope is 1 at most
        found = score.of_values(center) - gain * radius[..., 0] / score.scale
    else:
        inputs = Inputs((center - score.mean) / score.scale, None, radius / score.scale)
        found = gain * lower_bounds(score.net, inputs)[..., 0]
    found = found - ROUNDING * (jnp.abs(found) + 1.0)
    return jnp.where(cause.holds(center.shape[-3]), found, jnp.inf) if cause.who else found


def _braking(dynamics: Dynamics, motion: Motion, x: Array) -> Array:
    """(B, N, A) the actions that come nearest to standing still in the next row, as far as the World is linear."""
    own = motion.own
    nothing = jnp.zeros((*x.shape[:-1], dynamics.net.weights[0].shape[-2] - x.shape[-1]))

    def velocity(action: Array) -> Array:
        return dynamics.step(x, action)[0][..., own]

    size = nothing.shape[-1]
    columns = [jax.jvp(velocity, (nothing,), (jnp.zeros_like(nothing).at[..., k].set(1.0),)) for k in range(size)]
    after = columns[0][0]
    push = jnp.stack([column for _, column in columns], -1)  # (B, N, F, A)
    gram = jnp.swapaxes(push, -1, -2) @ push + 1e-6 * jnp.eye(size)
    wanted = -jnp.linalg.solve(gram, jnp.swapaxes(push, -1, -2) @ after[..., None])[..., 0]
    return wanted / jnp.maximum(jnp.abs(wanted).max(-1, keepdims=True), 1.0)


# --- what a ReLU network can give for all inputs in a set ---
# A ReLU whose sign is not known is held between two lines. Bounds of the outputs are then those of a linear function,
# which is found by going backward through the layers (CROWN, Zhang et al. 2018). What lines a ReLU gets is decided
# going forward, which is cheaper where layers are wide and inputs few.


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
