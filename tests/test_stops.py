"""What logs reach and never pass, nobody is predicted to pass."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import msgspec
import numpy as np
import pytest

from ringfence import EpisodeStore
from ringfence.deploy import zoo
from ringfence.errors import UserError
from ringfence.guards.proof import Box, Prover, motion_of
from ringfence.loading.resolve import load as load_run
from ringfence.problem.features import FeatureMap
from ringfence.training.worlds import fit
from ringfence.world import load, save, stops
from ringfence.world.dynamics import fit_dynamics
from ringfence.world.settings import Settings
from ringfence.world.stops import AHEAD, SPEED, Heading, Stop
from tests.quick import QUICK_WORLD

N = 2


def view(names, agents=N):
    """That sees the named entries of everybody."""
    entries = np.tile(np.arange(len(names)), (agents, 1))
    return FeatureMap("centralized", tuple(names), "observations", entries, np.full_like(entries, -1))


def logged(move, names, episodes=60, steps=40, actions=2, push=1.0, seed=0, after=lambda x: x):
    """(names, (states before, after (S, N, D), actions (S, N, A))) of bodies that `move` from rest."""
    rng = np.random.default_rng(seed)
    x = np.zeros((episodes, N, len(names)))
    rows, did = [after(x)], []
    drift = rng.uniform(-0.6, 0.6, (episodes, N, actions))
    for _ in range(steps):
        action = np.clip(drift + push * rng.normal(0, 0.4, drift.shape), -1, 1)
        x = move(x, action)
        rows.append(after(x))
        did.append(action)
    rows, did = np.stack(rows, 1).astype(np.float32), np.stack(did, 1).astype(np.float32)
    flat = lambda x: x.reshape(-1, N, x.shape[-1])  # noqa: E731
    return names, (flat(rows[:, :-1]), flat(rows[:, 1:]), flat(did))


def found(names, steps, alike=False):
    """By words, as the card has them."""
    map = view(names)
    every = np.arange(len(names))
    return sorted(stop.words for stop in stops.found(map, every, steps, np.ones(len(steps[0]), bool), alike))


def limited(most):
    """Discs that are pushed, each as fast as `most` (N,) at best."""

    def move(x, action):
        velocity = x + 0.3 * action
        size = np.linalg.norm(velocity, axis=-1, keepdims=True)
        return velocity * np.minimum(1.0, np.array(most)[:, None] / np.maximum(size, 1e-9))

    return move


def test_a_speed_that_is_limited_is_found():
    """Of each, or of all where they are as fast."""
    velocity = ["own.vx", "own.vy"]
    assert found(*logged(limited([1.5, 0.9]), velocity)) == [
        "own speed of agent 0 at 1.5",
        "own speed of agent 1 at 0.9",
    ]
    assert found(*logged(limited([1.5, 1.5]), velocity)) == ["own speed at 1.5"]
    assert found(*logged(limited([1.5, 1.5]), velocity), alike=True) == ["own speed at 1.5"]
    assert found(*logged(limited([1.5, 99.0]), velocity)) == ["own speed of agent 0 at 1.5"]
    square = lambda x, action: np.clip(x + 0.5 * action, -0.8, 0.8)  # noqa: E731
    each = found(*logged(square, velocity))
    assert each == ["own.vx at -0.8 and 0.8", "own.vy at -0.8 and 0.8"], "a corner is no limit of its own"
    assert found(*logged(limited([1.5, 0.9]), velocity), alike=True) == [], "of agents who are alike the fastest counts"


def test_entries_that_end_are_found_and_what_is_merely_common_is_not():
    """A tank is full, a room has walls. Who waits may back up, a command of one is no end, and readings are rounded."""
    full = lambda x, action: np.clip(x + 0.2 * action[..., :1], 0.0, 1.0)  # noqa: E731
    assert found(*logged(full, ["own.level"])) == ["own.level at 0 and 1"]
    waits = lambda x, action: np.maximum(action[..., :1], 0.0)  # noqa: E731
    assert found(*logged(waits, ["own.v"], after=lambda x: x)) == ["own.v at 0"], "asked to back up it stayed"
    names, (before, after, action) = logged(waits, ["own.v"])
    assert found(names, (before, after, np.maximum(action, 0.0))) == [], "nobody asked it to"
    commanded = lambda x, action: action[..., :1]  # noqa: E731
    assert found(*logged(commanded, ["own.v"], push=3.0)) == []
    free = lambda x, action: 0.9 * x + 0.2 * action[..., :1]  # noqa: E731
    assert found(*logged(free, ["own.v"])) == []
    assert found(*logged(free, ["own.v"], after=lambda x: np.round(x, 1))) == []
    assert found(*logged(lambda x, action: x, ["own.size"])) == []


def test_nobody_goes_beyond_a_stop():
    """Nor farther than before; what is relative goes with the own velocity."""
    names = ("own.x", "own.vx", "own.vy", "post.dvx", "post.dvy")
    map = view(names)
    before = jnp.zeros((3, N, 5)).at[2, :, 1].set(3.0)
    after = before + jnp.array([2.0, 3.0, 4.0, -3.0, -4.0])
    known = (Stop("own.x", -1.0, 1.0, 0), Stop(SPEED, None, 2.5))
    x = np.asarray(stops.saturated(known, map, before, after))
    np.testing.assert_allclose(x[0], [[1, 1.5, 2, -1.5, -2], [2, 1.5, 2, -1.5, -2]], rtol=1e-5)
    assert np.allclose(np.linalg.norm(x[2, :, 1:3], axis=-1), 3.0, rtol=1e-5), "no faster than it was"
    assert stops.saturated((), map, before, after) is after
    one = np.asarray(stops.saturated((Stop(SPEED, None, 2.5, 1),), map, before, after))
    assert np.array_equal(one[0, 0], after[0, 0]) and np.allclose(one[0, 1, 1:3], [1.5, 2.0]), "nothing stops the first"
    slope = jax.grad(lambda x: stops.saturated(known, map, before, x).sum())(jnp.zeros_like(after))
    assert np.isfinite(slope).all(), "at rest, too"


def test_networks_are_not_slow_before_a_stop():
    """Taught that a stop is no law of theirs, they err less next to it: a smooth bend would begin before it."""
    names, steps = logged(lambda x, action: np.clip(x + 0.3 * action[..., :1], -0.8, 0.8), ["own.v"], steps=50)
    features = np.stack(steps[:2], 1).reshape(-1, N, 1)
    row = jnp.arange(0, len(features), 2)
    settings = Settings(num_ensemble=2, dynamics_updates=600, dynamics_width=16)
    errors = []
    for known in ((), (Stop("own.v", -0.8, 0.8),)):
        given = jnp.asarray(features), jnp.asarray(steps[2]), row, view(names), jax.random.key(0), settings
        model = fit_dynamics(*given, known)
        before = jnp.full((9, N, 1), 0.6)
        action = jnp.linspace(0.1, 0.6, 9)[:, None, None] * jnp.ones((1, N, 2))
        after, _ = model.step(before, action)
        errors.append(float(jnp.abs(after - (before + 0.3 * action[..., :1])).max()))
        pressed = model.step(jnp.full((9, N, 1), 0.8), action)[1]
        if known:
            assert float(pressed.max()) < 0.05, "who presses on is not out of distribution"
    assert errors[1] < 0.5 * errors[0]


def test_who_never_went_backwards_is_not_predicted_to():
    """Nobody brakes at rest in logs of cars, so networks do not learn that they stay where they are."""
    heading = Heading((0, 1), (2, 3))
    assert Heading.of(["own.vx", "own.vy", "own.cos", "own.sin"]) == heading
    assert Heading.of(["own.speed", "own.cos", "own.sin"]) == Heading((0,), (1, 2))
    assert Heading.of(["own.vx", "own.vy"]) is None
    back = jnp.array([[-0.6, -0.8, 0.6, 0.8], [0.3, 0.4, 0.6, 0.8]])
    np.testing.assert_allclose(heading.no_slower(back, 0.0), [[0, 0, 0.6, 0.8], [0.3, 0.4, 0.6, 0.8]], atol=1e-6)
    np.testing.assert_allclose(heading.no_slower(back, -0.5)[0, :2], [-0.3, -0.4], atol=1e-6)
    np.testing.assert_allclose(Heading((0,), (1, 2)).no_slower(back, 0.1)[:, 0], [0.1, 0.3], rtol=1e-5)
    names = ("own.v", "own.cos", "own.sin", "thing_a.dvy", "own.dvx", "other1.dvx", "other1.dx")
    asked = jnp.array([[-1.0, 0.6, 0.8, 0.0, 0.0, 0.0, 0.0]])
    moved = stops.saturated((Stop(AHEAD, 0.0),), view(names, 1), asked, asked)
    np.testing.assert_allclose(moved, [[0, 0.6, 0.8, -0.8, 0, -0.6, 0]], atol=1e-6)


def test_a_car_that_brakes_at_rest_stays(tmp_path):
    """In logs of who never does so. What a file holds is the same World."""
    rng = np.random.default_rng(0)
    turn = rng.uniform(-np.pi, np.pi, (12, 1, N)).repeat(31, 1)
    action = rng.uniform(-1, 1, (12, 30, N, 2)).astype(np.float32)
    speed = np.zeros((12, 31, N))
    for t in range(30):
        action[:, t, :, 0] = np.where(speed[:, t] < 0.3, np.abs(action[:, t, :, 0]), action[:, t, :, 0])
        speed[:, t + 1] = np.maximum(speed[:, t] + 0.2 * action[:, t, :, 0], 0.0)
    seen = np.stack([speed * np.cos(turn), speed * np.sin(turn), np.cos(turn), np.sin(turn)], -1)
    names = ["own.vx", "own.vy", "own.cos", "own.sin"]
    card = {"task": "cars", "observation_names": names, "dt": 0.2, "homogeneous": True}
    store = EpisodeStore.from_episodes(seen, action, np.zeros((12, 30)), (speed[:, 1:] > 1.5) * 1.0, card=card)
    made = fit(store, **QUICK_WORLD)
    assert made.dynamics.stops == (Stop(AHEAD, pytest.approx(0.0)),)
    rest = jnp.array([[[0.0, 0.0, 1.0, 0.0]]])
    brake = jnp.array([[[-1.0, 0.0]]])
    free = dataclasses.replace(made.dynamics, stops=())
    assert free.step(rest, brake)[0][0, 0, 0] < -0.02 and made.dynamics.step(rest, brake)[0][0, 0, 0] > -1e-5
    again = load(save(made, tmp_path / "w.safetensors"))
    assert again.dynamics.stops == made.dynamics.stops == again.card.data.stops


@pytest.mark.parametrize(
    "wrong",
    [
        *(Stop("own.v", 0.0, 1.0), Stop(SPEED, None, 1.0, 9), Stop(SPEED, 1.0), Stop(AHEAD)),
        *(Stop("own.x", 5.0, -5.0), Stop("own.x", -1e308), Stop("own.x"), Stop(SPEED, None, -1.0), Stop(AHEAD, 1.0)),
    ],
)
def test_a_file_with_stops_of_somebody_else_is_refused(wrong, small_world, tmp_path):
    assert Stop(small_world.map.names[0], -5.0, 5.0).fits(small_world.map)
    data = msgspec.structs.replace(small_world.card.data, stops=(wrong,))
    card = msgspec.structs.replace(small_world.card, data=data)
    file = save(dataclasses.replace(small_world, card=card), tmp_path / "w.safetensors")
    with pytest.raises(UserError, match="has stops of agents or entries that it does not know, or where no log ends"):
        load(file)


def test_a_proof_holds_at_a_stop(tmp_path):
    """States that are reached by pushing on lie within the boxes that are proved."""
    guarded = load_run(zoo.pretrained("crossing-hasty/bc", tmp_path), guard="shield")[1].one
    world = guarded.guard.world
    known = (Stop(SPEED, None, 0.5), Stop("own.vx", -0.3, 0.4))
    world = eqx.tree_at(lambda w: w.dynamics, world, dataclasses.replace(world.dynamics, stops=known))
    prover = Prover(world, 0.02, 0.0, 10)
    own = motion_of(world.map).own
    present = jnp.zeros((1, 1, len(world.map.names))).at[..., own].set(jnp.array([0.2, -0.1]))
    plan = jnp.broadcast_to(jnp.array([0.9, 0.7]), (1, 10, 1, 2))
    box: Box = prover.reached(present, plan)
    x = present + jnp.zeros((400, 1, 1)).at[..., 0].set(0.0)
    x = x.at[..., own].add(0.02 * jax.random.uniform(jax.random.key(0), (400, 1, 2), minval=-1, maxval=1))
    for row in range(10):
        x, _ = world.dynamics.step(x, jnp.broadcast_to(plan[0, row], (400, 1, 2)))
        away = jnp.abs(x - box.center[0, row])[..., own] - box.radius[0, row][..., own]
        assert float(away.max()) <= 0.0, row
    assert float(jnp.linalg.norm(x[..., own], axis=-1).max()) <= 0.5 + 1e-5
