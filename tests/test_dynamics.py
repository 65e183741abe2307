"""What actions do, as learned from logs."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ringfence.problem.features import FeatureMap
from ringfence.world.dynamics import blank_dynamics, fit_dynamics
from ringfence.world.settings import Settings

EPISODES, STEPS, AGENTS = 40, 50, 2


def view(joint: bool) -> FeatureMap:
    """The points as they are; of a body, each point's entries in its own order."""
    table = np.array([[0, 1, 2, 3], [2, 3, 0, 1]]) if joint else np.tile([0, 1], (AGENTS, 1))
    names = ("x", "v", "other.x", "other.v")[: table.shape[1]]
    return FeatureMap("pruned", names, "state", table, np.full_like(table, -1), shared_body=joint, joint=joint)


def log(joint: bool):
    """Points (x, v) that their own action accelerates, or everybody's sum: features, actions, row of every step."""
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (EPISODES, STEPS, AGENTS, 1))
    push = actions.sum(2, keepdims=True) * np.ones((1, 1, AGENTS, 1)) if joint else actions
    start = np.zeros((EPISODES, 1, AGENTS, 1))
    v = np.concatenate([start, 0.3 * push.cumsum(1)], 1)
    x = np.concatenate([start, 0.1 * v[:, :-1].cumsum(1)], 1)
    features = np.concatenate([x, v], -1).reshape(-1, AGENTS, 2)
    row = (np.arange(EPISODES)[:, None] * (STEPS + 1) + np.arange(STEPS)).ravel()
    return (
        jnp.asarray(features, jnp.float32),
        jnp.asarray(actions.reshape(-1, AGENTS, 1), jnp.float32),
        jnp.asarray(row),
    )


@pytest.mark.parametrize("joint", [False, True])
def test_it_learns_what_actions_do(joint):
    """To a twentieth of what a step changes; where agents share a body, by everybody's action, and all agree."""
    features, actions, row = log(joint)
    if joint:
        features = jnp.concatenate([features, features[:, ::-1]], -1)
    settings = Settings(num_ensemble=2, dynamics_updates=1500, dynamics_width=16)
    dynamics = fit_dynamics(features, actions, row, view(joint), jax.random.key(0), settings)
    foreseen, spread = dynamics.step(features[row], actions)
    error, moved = foreseen - features[row + 1], features[row + 1] - features[row]
    assert jnp.sqrt((error**2).mean()) < 0.05 * jnp.sqrt((moved**2).mean())
    assert spread.shape == foreseen.shape[:-1] and (spread > 0).all()
    far, apart = dynamics.step(features[row] + 30.0, actions)
    assert apart.mean() > 3 * spread.mean()  # where the logs have not been, the members disagree


def test_what_never_changes_within_an_episode_is_left_alone():
    features, actions, row = log(False)
    length = jnp.repeat(jax.random.uniform(jax.random.key(1), (EPISODES, 1)), STEPS + 1, 0)[..., None]
    long = jnp.concatenate([features, jnp.broadcast_to(length, (*features.shape[:2], 1))], -1)
    map = replace(view(False), names=("x", "v", "length"))
    settings = Settings(num_ensemble=2, dynamics_updates=20, dynamics_width=8)
    dynamics = fit_dynamics(long, actions, row, map, jax.random.key(0), settings)
    foreseen, _ = dynamics.step(long[row] + 1.0, actions)
    assert (foreseen[..., 2] == long[row, :, 2] + 1.0).all()
    once = long.at[-1, 0, 2].add(0.1)  # it changes in one step
    assert (fit_dynamics(once, actions, row, map, jax.random.key(0), settings).step_scale > 0).all()


def test_agents_that_do_not_share_a_body_do_not_read_each_other():
    dynamics = blank_dynamics(view(False), 1, 2, 8)
    x, action = jnp.ones((3, AGENTS, 2)), jnp.ones((3, AGENTS, 1))
    moved = dynamics.step(x, action.at[:, 1].set(-1.0))[0] - dynamics.step(x, action)[0]
    assert (moved[:, 0] == 0).all() and (moved[:, 1] != 0).all()
    shared = blank_dynamics(view(True), 1, 2, 8)
    x = jnp.ones((3, AGENTS, 4))
    moved = shared.step(x, action.at[:, 1].set(-1.0))[0] - shared.step(x, action)[0]
    assert (moved != 0).any(-1).all()


@pytest.mark.parametrize("models_others", [True, False])
def test_who_guesses_what_others_see_does_not_take_its_own_action_for_the_cause(models_others):
    """The first agent acts roughly as a wind blows that only the second sees, and the wind alone moves it: it foresees
    nothing of its own action, unless it has nothing else to tell the wind by."""
    rng = np.random.default_rng(0)
    wind = rng.uniform(-1, 1, EPISODES * STEPS)
    place = np.concatenate([[0], np.cumsum(wind[:-1])]) / 20
    features = jnp.asarray(np.stack([place, wind], 1)[..., None], jnp.float32)
    acts = np.stack([wind + rng.normal(0, 0.5, len(wind)), rng.uniform(-1, 1, len(wind))], 1)
    actions = jnp.asarray(acts[..., None], jnp.float32)
    table = np.array([[0], [1]])
    map = FeatureMap("decentralized", ("seen",), "observations", table, np.full_like(table, -1))
    map = replace(map, models_others=models_others)
    row = jnp.arange(len(wind) - 1)
    settings = Settings(num_ensemble=2, dynamics_updates=1500, dynamics_width=16)
    dynamics = fit_dynamics(features, actions[:-1], row, map, jax.random.key(0), settings)
    pushed, pulled = (dynamics.step(features[:-1], actions[:-1].at[:, 0].set(a))[0][:, 0] for a in (1.0, -1.0))
    effect = jnp.abs(pushed - pulled).mean() / (2 / 20)  # of what the wind does
    assert effect < 0.2 if models_others else effect > 0.5
