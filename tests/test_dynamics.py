"""What actions do, as learned from logs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ringfence.dynamics import blank_dynamics, fit_dynamics, foresee

EPISODES, STEPS, AGENTS = 40, 50, 2


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
    """To a twentieth of what a step changes; where agents share a body, by everybody's action."""
    features, actions, row = log(joint)
    dynamics = fit_dynamics(features, actions, row, jax.random.key(0), 1500, 16, joint)
    foreseen = foresee(dynamics, features[row], actions, joint)
    error, moved = foreseen - features[row + 1], features[row + 1] - features[row]
    assert jnp.sqrt((error**2).mean()) < 0.05 * jnp.sqrt((moved**2).mean())


def test_agents_that_do_not_share_a_body_do_not_read_each_other():
    dynamics = blank_dynamics(AGENTS, 2, 1, 8)
    x, action = jnp.ones((3, AGENTS, 2)), jnp.ones((3, AGENTS, 1))
    moved = foresee(dynamics, x, action.at[:, 1].set(-1.0)) - foresee(dynamics, x, action)
    assert (moved[:, 0] == 0).all() and (moved[:, 1] != 0).all()
    shared = blank_dynamics(AGENTS, 2, 1, 8, joint=True)
    moved = foresee(shared, x, action.at[:, 1].set(-1.0), True) - foresee(shared, x, action, True)
    assert (moved != 0).any(-1).all()
