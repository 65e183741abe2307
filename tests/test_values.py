"""What states and windows are worth."""

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.envs import SimpleSpread
from ringfence.logs.store import EpisodeStore
from ringfence.logs.windows import WindowData
from ringfence.problem.constraints import Separation
from ringfence.proposals import conditions
from ringfence.world import Settings, values


def test_advantages_match_their_definition():
    """Σ γ^h r + γ^n V(s_{t+n}) − V(s_t) by brute force, with V = 0 at the end of an episode."""
    rng = np.random.default_rng(0)
    lengths, horizon, discount = [3, 7, 1], 4, 0.9
    ends = np.cumsum(lengths)
    team, value = rng.normal(size=11), rng.normal(size=14)
    row = np.arange(11) + np.repeat(np.arange(3), lengths)
    last = np.repeat(ends + np.arange(3), lengths)
    got = conditions.advantages(value, team, row, last, horizon, discount)
    for t in range(11):
        left = last[t] - row[t]
        n = min(horizon - 1, left)
        expected = sum(discount**h * team[t + h] for h in range(n)) - value[row[t]]
        if left > n:
            expected += discount**n * value[row[t] + n]
        np.testing.assert_allclose(got[t], expected, atol=1e-12)


def test_normal_scores_are_ordered_and_standard():
    x = np.random.default_rng(0).exponential(size=5000)
    z = conditions.normal_scores(x)
    assert (np.diff(z[np.argsort(x)]) > 0).all()
    assert abs(z.mean()) < 1e-6 and abs(z.std() - 1) < 0.01


def test_critic_learns_what_is_there_to_learn():
    """A team reward that is linear in every agent's features, and a return-to-go that is quadratic."""
    x = jax.random.normal(jax.random.key(0), (4000, 3, 4))
    reward = x[..., 0].mean(-1)
    returns = (x[..., 1] ** 2).mean(-1)
    critic = values.fit_critic(x, reward, returns, jax.random.key(1), updates=600, batch=256)
    r, g = values.state_values(critic, x)
    for got, truth in ((r, reward), (g, returns)):
        assert float(1 - ((got - truth) ** 2).mean() / truth.var()) > 0.9
    np.testing.assert_allclose(values.values_of(critic, x), np.asarray(g), rtol=1e-5, atol=1e-5)


def test_features_are_standardised_by_all_agents_and_all_moments():
    """Two agents who see other things, 26 rows to an episode, twice as many rows as are looked at."""
    episodes, rows = 2 * values.STATES // 26, 26
    speed = np.tile(np.where(np.arange(rows) % 2, 1.0, 0.0), episodes)  # nobody moves at even times
    x = np.stack([speed, speed + 5.0], 1)[..., None].astype(np.float32)
    critic = values.fit_critic(jnp.asarray(x), speed, speed, jax.random.key(0), updates=1, batch=4, period=rows)
    np.testing.assert_allclose(critic["mean"], x.mean((0, 1)), rtol=0.01)
    np.testing.assert_allclose(critic["scale"], x.std((0, 1)), rtol=0.01)


def test_entries_are_read_by_their_weight():
    """An entry of weight w moves the critic w times as much; Simple Spread's velocities are read at a quarter."""
    x = jax.random.normal(jax.random.key(0), (400, 2, 3)) * jnp.asarray([1.0, 2.0, 5.0])
    target = x[..., 0].mean(-1)
    plain, weighed = (
        values.fit_critic(x, target, target, jax.random.key(0), 1, 4, weight=w) for w in (None, (1, 0.5, 0))
    )
    np.testing.assert_allclose(weighed["scale"], plain["scale"] * jnp.asarray([1.0, 2.0, jnp.inf]), rtol=1e-6)
    r, _ = values.state_values(weighed, x)
    again, _ = values.state_values(weighed, x.at[..., 2].set(0.0))
    np.testing.assert_array_equal(r, again)
    view = SimpleSpread().feature_map("pruned")
    weights = dict(zip(view.names, view.critic_weight))
    assert weights["own.vx"] == weights["other1.dvy"] == 0.25 and weights["own.x"] == weights["landmark0.dx"] == 1.0


def test_what_ended_for_good_is_worth_nothing(played, monkeypatch):
    """The critic reads the states that falls left behind, too, with the reward of the fall and no return to go."""
    fallen = np.zeros(40, bool)
    fallen[:3] = True
    card = {"task": "fallen", "hazard": Separation()}
    parts = (played[k] for k in ("observations", "actions", "rewards", "costs"))
    store = EpisodeStore.from_episodes(*parts, state=played["state"], terminated=fallen, card=card)
    view = SimpleSpread().feature_map("pruned")
    seen = {}

    def fit_critic(x, arrived, returns, *_, **__):
        seen.update(x=x, arrived=arrived, returns=returns)
        return values.blank_critic(x.shape[-1])

    monkeypatch.setattr(values, "fit_critic", fit_critic)
    arrays = WindowData(store, view).arrays | {"returns_to_go": jnp.ones(store.steps)}
    picked = jnp.arange(25, store.steps)  # the first fall is held out
    values.fit_values(arrays, picked, view, jax.random.key(0), Settings(value_updates=1), period=26)
    assert len(seen["x"]) == len(seen["returns"]) == len(picked) + 2
    np.testing.assert_array_equal(seen["returns"][-3:], [1, 0, 0])
    np.testing.assert_array_equal(seen["x"][-2:], arrays["features"][jnp.asarray([51, 77])])
    np.testing.assert_allclose(seen["arrived"][-1], store.rewards[74].mean(), rtol=1e-6)
