"""Crossing's data sets: the safety barrier certificates of Wang, Ames and Egerstedt (2017, "Safety barrier certificates
for collisions-free multirobot systems", IEEE T-RO 33(3)), decentralised as in their section V, around a controller that
heads for its goal: with room to spare and slowly (`careful`), or at full speed, with none, by somebody who trusts the
brakes too much and steers with an unsteady hand (`hasty`); or by four with habits of their own (`pooled`)."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp

from ringfence.datasets.behaviour import gather, rollout
from ringfence.datasets.recipes import COLLECTION, RECIPES
from ringfence.datasets.task import Card, Recipe, Task
from ringfence.envs.crossing import DT, PUSH, RADIUS, SOON, TURN, Crossing, CrossingState, length
from ringfence.errors import UserError
from ringfence.logs.store import EpisodeStore
from ringfence.types import Array, Key, Policy, PolicyStep, PyTree

BATCH = 500  # episodes that are played at once
ROUNDS = 15  # of Hildreth's method on the programme of a step
SLOW = 0.25  # m/s: a unicycle that is slower turns as if it were that fast
STUBBORN = 0.1  # of full push: what a head-on encounter is broken by


@dataclass(frozen=True)
class Driver:
    """How somebody drives."""

    speed: float  # m/s, towards the goal
    brake: float  # m/s² that it believes everybody has
    room: float  # m between rims that it keeps
    haste: float  # γ of the certificate: how fast it may be used up
    unsteady: float  # deviation of its hand
    side: float = 0.0  # of full push to the right of its way while somebody ahead is near; below 0 to the left


DRIVERS = {
    "careful": Driver(0.6, 1.0, 0.05, 1.0, 0.0),
    "hasty": Driver(1.0, 1.1, 0.0, 2.0, 0.1),
}
STEADY = Driver(1.0, 0.9, 0.1, 2.0, 0.0)
TIERS = ("careful", "hasty", "mixed", "random")
# Those of the tier `pooled`: no state tells who it is, and the mean of the last two does neither.
HABITS = DRIVERS | {
    "keeps right": Driver(0.8, 1.0, 0.05, 1.0, 0.05, side=0.5),
    "keeps left": Driver(0.8, 1.0, 0.05, 1.0, 0.05, side=-0.5),
}
TURNS = "its number, and the agent's, modulo 4"
SIDELESS = 5  # fields of a driver without `side`
NEAR = 2.0  # m: who is nearer and ahead is kept to one side of


def about(task: Task) -> Card:
    """The simulator, for the card."""
    env = _env(task)
    room = f"{env.body}, goals {env.goals}, {env.spacing:g} m apart"
    return {"simulator": f"ringfence {RECIPES} crossing, {room}, {env.neighbours} seen who come nearest in {SOON:g} s"}


class Driven(eqx.Module):
    """A driver as a policy: it reads the state, which tells where everybody is."""

    env: Crossing = eqx.field(static=True)
    driver: Driver = eqx.field(static=True)

    def initial_state(self, batch: int) -> PyTree:
        return {}

    def act(self, carry: PyTree, observations: Array, state: Array | None, key: Key) -> tuple[PyTree, PolicyStep]:
        if state is None:
            raise UserError("The certificates read the global state; pass it.")
        now = self.env.from_global_state(state)
        driver = jnp.broadcast_to(jnp.array(astuple(self.driver)[:SIDELESS]), (*observations.shape[:2], SIDELESS))
        return carry, PolicyStep(drive(self.env, now, driver, key), {})


def references(task: Task) -> dict[str, Policy]:
    """The tier's driver, and the certificates at their best: full speed, with the brakes that there are."""
    env = _env(task)
    policies: dict[str, Policy] = {}
    if task.tier in DRIVERS:
        policies["behaviour policy"] = Driven(env, DRIVERS[task.tier])
    policies["certificates"] = Driven(env, STEADY)
    return policies


def collect(task: Task, transitions: int, seed: int, card: Card) -> EpisodeStore:
    """The data set of a tier."""
    env = _env(task)
    if env.obstacles or env.walls:
        raise UserError(f"'{task.name}' has obstacles or walls that the drivers do not know; log it otherwise.")
    key = jax.random.fold_in(jax.random.key(COLLECTION), seed)

    def chunk(number: int) -> dict[str, Array]:
        return _played(env, task.tier, jax.random.fold_in(key, number * BATCH), BATCH)

    episodes = gather(chunk, transitions // env.episode_length, BATCH)
    return EpisodeStore.from_episodes(
        **episodes,
        card=card
        | {
            "transitions": transitions,
            "collected": _how(task.tier),
            "observation_names": list(env.observation_names),
        }
        | ({"drivers": list(HABITS), "driver_of_episode": TURNS} if task.tier == "pooled" else {}),
    )


def _how(tier: str) -> str:
    """Who drove, for the card."""
    if tier == "random":
        return "pushes that change ten times an episode"
    if tier == "mixed":
        return "a driver for each agent and episode, between careful and hasty"
    if tier == "pooled":
        return f"safety barrier certificates around drivers of four habits ({', '.join(HABITS)}), in turn"
    return f"safety barrier certificates, {DRIVERS.get(tier)}"


def _env(task: Task) -> Crossing:
    assert isinstance(task.env, Crossing), "only tasks of Crossing name this recipe"
    return task.env


@partial(jax.jit, static_argnums=(0, 1, 3))
def _played(env: Crossing, tier: str, key: Key, batch: int) -> dict[str, Array]:
    """Arrays (B, L, ...) of a batch of a tier's episodes."""
    key_reset, key_driver, key_action = jax.random.split(key, 3)
    first = env.reset(key_reset, batch)
    steps = jnp.arange(env.episode_length)
    if tier == "random":
        shape = (len(steps) // 10 + 1, batch, env.n_agents, 2)
        held = jax.random.uniform(key_driver, shape, minval=-1.0, maxval=1.0)
        return rollout(env, first, lambda state, step: held[step // 10], steps)
    driver = _drivers(tier, key_driver, batch, env.n_agents)

    def choose(state: CrossingState, step: Array) -> Array:
        return drive(env, state, driver, jax.random.fold_in(key_action, step))

    return rollout(env, first, choose, steps)


def _drivers(tier: str, key: Key, batch: int, agents: int) -> Array:
    """(B, N, 5) a driver for each agent and episode, (B, N, 6) of those who keep to a side."""
    if tier == "pooled":
        turn = (jnp.arange(batch)[:, None] + jnp.arange(agents)) % len(HABITS)  # batches hold all of them equally
        return jnp.array([astuple(d) for d in HABITS.values()])[turn]
    if tier != "mixed":
        return jnp.broadcast_to(jnp.array(astuple(DRIVERS[tier])[:SIDELESS]), (batch, agents, SIDELESS))
    careful = jnp.array(astuple(DRIVERS["careful"])[:SIDELESS])
    hasty = jnp.array(astuple(DRIVERS["hasty"])[:SIDELESS])
    share = jax.random.uniform(key, (batch, agents, 1))
    return careful + share * (hasty - careful)


def drive(env: Crossing, state: CrossingState, driver: Array, key: Key) -> Array:
    """Actions (B, N, 2) of drivers (B, N, 5 or 6): towards the goal, as near to it as the certificates allow."""
    speed, brake, room, haste, unsteady = jnp.moveaxis(driver[..., :SIDELESS], -1, 0)
    key_push, key_hand = jax.random.split(key)
    ahead = state.goal - state.position
    far = length(ahead)
    wanted = ahead / far[..., None] * jnp.minimum(speed, jnp.sqrt(1.6 * far))[..., None]
    push = _bounded(0.5 * (wanted - state.velocity) / (DT * PUSH))
    push = push + STUBBORN * jax.random.normal(key_push, push.shape)
    if driver.shape[-1] > SIDELESS:
        push = _bounded(push + _aside(env, state, ahead / far[..., None], driver[..., SIDELESS]))
    push = certified(env, state, push, brake[..., None], room[..., None], haste[..., None])
    if env.body == "unicycle":
        push = steered(state, push)
    return jnp.clip(push + unsteady[..., None] * jax.random.normal(key_hand, push.shape), -1.0, 1.0)


def _aside(env: Crossing, state: CrossingState, way: Array, side: Array) -> Array:
    """(B, N, 2) the push to one `side` (B, N) of one's `way` (B, N, 2), stronger the nearer somebody ahead is."""
    offset, _ = env.nearest(state)
    far = length(offset)
    ahead = (offset * way[..., None, :]).sum(-1) > 0.5 * far  # within 60 degrees of the way
    near = jnp.where(ahead, jnp.maximum(1.0 - far / NEAR, 0.0), 0.0).max(-1)
    right = jnp.stack([way[..., 1], -way[..., 0]], -1)
    return (side * near)[..., None] * right


def steered(state: CrossingState, push: Array) -> Array:
    """A unicycle's push along its heading and turn (B, N, 2) that move it as `push` would move a disc, as far as they
    can: across its heading it is moved by turning, and the faster it is, the less of that it needs."""
    x, y = jnp.cos(state.heading), jnp.sin(state.heading)
    along, across = push[..., 0] * x + push[..., 1] * y, push[..., 1] * x - push[..., 0] * y
    turn = PUSH * across / jnp.maximum(length(state.velocity), SLOW) / TURN
    return jnp.clip(jnp.stack([along, turn], -1), -1.0, 1.0)


def certified(env: Crossing, state: CrossingState, push: Array, brake: Array, room: Array, haste: Array) -> Array:
    """The pushes nearest to `push` (B, N, 2) of which each agent's half of every pair's certificate holds,

        −Δpᵀu ≤ ½ (γ h³ ‖Δp‖ − (Δvᵀ Δp)² / ‖Δp‖² + ‖Δv‖² + 2a Δvᵀ Δp / √(4a (‖Δp‖ − D)))
        h = √(4a (‖Δp‖ − D)) + Δpᵀ Δv / ‖Δp‖

    with the `neighbours` that one sees: a quadratic programme in the plane, by Hildreth's method."""
    if env.n_agents == 1:
        return push
    offset, theirs = env.nearest(state)
    gap, speed = -offset, -theirs
    far = length(gap)
    left = jnp.maximum(far - 2 * RADIUS - room, 1e-3)
    root, closing = jnp.sqrt(4 * brake * left), (gap * speed).sum(-1)
    h = root + closing / far
    bound = haste * h**3 * far - (closing / far) ** 2 + (speed**2).sum(-1) + 2 * brake * closing / root
    normal, bound = -gap / far[..., None], 0.5 * bound / far

    def of_one(price: Array, j: Array) -> tuple[Array, None]:
        u = push - (price[..., None] * normal).sum(-2)
        new = price[..., j] + (normal[..., j, :] * u).sum(-1) - bound[..., j]
        return price.at[..., j].set(jnp.maximum(new, 0.0)), None

    price = jnp.zeros_like(bound)
    price, _ = jax.lax.scan(of_one, price, jnp.tile(jnp.arange(bound.shape[-1]), ROUNDS))
    return _bounded(push - (price[..., None] * normal).sum(-2))


def _bounded(push: Array) -> Array:
    return push / jnp.maximum(length(push), 1.0)[..., None]


RECIPE = Recipe(about=about, collect=collect, references=references)
