"""The actor-critic baselines: what their losses ask for, on networks small enough to compute by hand."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ringfence.algos import actor_critic as ac
from ringfence.algos import fisor, icbf, omar, td3bc
from ringfence.datasets import registry
from ringfence.errors import UserError
from ringfence.nets.optim import Optimiser
from ringfence.problem.normalise import Normaliser
from ringfence.training.job import make_job
from ringfence.types import Batch, Spec
from ringfence.utils.config import build_config
from ringfence.world import Settings

SPEC = Spec("t", 2, 2, ("a", "b", "c"), -1.0, 1.0, 25)


def by_hand(critics: ac.Critics, x, action, agent: int, head: int) -> np.ndarray:
    """The same network, one agent and head, in NumPy."""
    g = 2 * agent + head
    w = [np.asarray(v[g]) for v in jax.tree.leaves(critics)]
    names = ("of_state", "of_action", "bias", "hidden", "hidden_bias", "out", "out_bias")
    p = dict(zip(names, w))
    y = np.maximum(x[:, agent] @ p["of_state"] + action[:, agent] @ p["of_action"] + p["bias"], 0)
    y = np.maximum(y @ p["hidden"] + p["hidden_bias"], 0)
    return (y @ p["out"] + p["out_bias"])[:, 0]


def test_critics_are_the_networks_they_say():
    """Every agent and head has weights of its own, and a sampled action is scored like a lone one."""
    k = jax.random.split(jax.random.key(0), 4)
    critics = ac.Critics(k[0], 2, 2, 3, 2, 8)
    critics = jax.tree.map(lambda w: w + 0.1, critics)  # biases that are not zero
    x, actions = jax.random.normal(k[1], (5, 2, 3)), jax.random.uniform(k[2], (5, 2, 4, 2))
    several = critics(x, actions)
    assert several.shape == (2, 2, 5, 4)
    for s in range(4):
        np.testing.assert_allclose(several[..., s], critics(x, actions[:, :, s]), rtol=1e-5, atol=1e-6)
    one = critics(x, actions[:, :, 0])
    for agent in range(2):
        for head in range(2):
            expected = by_hand(critics, np.asarray(x), np.asarray(actions[:, :, 0]), agent, head)
            np.testing.assert_allclose(one[agent, head], expected, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(critics.first(2)(x, actions[:, :, 0])[:, 0], one[:, 0], rtol=1e-6)


def test_pieces_change_nothing():
    x = jnp.arange(24.0).reshape(12, 2)
    whole = x.sum(1) ** 2
    np.testing.assert_array_equal(ac.in_pieces(lambda z: z.sum(1) ** 2, 4, x).reshape(-1), whole)
    assert ac.pieces_of(1024) == 32 and ac.pieces_of(30) == 1 and ac.pieces_of(17 * 64) == 34


class Bowl:
    """A critic whose best action is known: −‖a − goal‖²."""

    def __init__(self, goal):
        self.goal = jnp.asarray(goal)

    def first(self, agents):
        return self

    def __call__(self, x, actions):
        gone = actions - (self.goal if actions.ndim == 3 else self.goal[:, :, None])
        return jnp.moveaxis(-10 * (gone**2).sum(-1), 1, 0)[:, None]


@pytest.mark.parametrize("search", ["softmax", "elites"])
def test_the_search_finds_the_best_action_and_never_does_worse_than_the_actor(search):
    config = omar.Config(search=search, search_samples=60, elites=6)
    goal = np.array([[0.5, -0.3], [-0.8, 0.9]])
    critic = Bowl(np.broadcast_to(goal, (7, 2, 2)))
    noise = jax.random.normal(jax.random.key(0), (7, 2, 3, 60, 2))
    x, own = jnp.zeros((7, 2, 3)), jnp.full((7, 2, 2), 0.9)
    found = omar.rectified(critic, x, own, noise, config, SPEC)
    value = critic(x, found)[:, 0]
    assert (value >= critic(x, own)[:, 0]).all()
    assert np.abs(np.asarray(found) - goal).max() < 0.45
    perfect = jnp.broadcast_to(jnp.asarray(goal), (7, 2, 2))
    np.testing.assert_array_equal(omar.rectified(critic, x, perfect, noise, config, SPEC), perfect)


def test_joint_critics_see_the_own_action_of_their_agent_alone():
    action, own = jnp.arange(8.0).reshape(2, 2, 2), -jnp.ones((2, 2, 2))
    seen = np.asarray(ac.joint_actions(action, own)).reshape(2, 2, 2, 2)
    for i in range(2):
        np.testing.assert_array_equal(seen[:, i, i], own[:, i])
        np.testing.assert_array_equal(seen[:, i, 1 - i], action[:, 1 - i])


def test_expectile_is_asymmetric():
    errors = np.array([-2.0, 1.0])
    np.testing.assert_allclose(fisor.expectile(jnp.asarray(errors), 0.9), [0.1 * 4, 0.9], rtol=1e-6)
    # Its minimiser over a sample is the expectile: from above for τ = 0.9.
    sample, grid = jnp.asarray([0.0, 1.0]), jnp.linspace(0, 1, 1001)
    best = grid[jnp.argmin(fisor.expectile(sample[None] - grid[:, None], 0.9).sum(1))]
    assert abs(float(best) - 0.9) < 2e-3


@pytest.mark.parametrize("learner, more", [(td3bc, {"target_noise": 0.2}), (omar, {"cql_actions": "policy"})])
def test_bounds_of_actions_change_no_lesson(learner, more):
    """Batches tell actions between −1 and 1, so the task's own bounds are nothing to a learner."""
    config = learner.Config(width=4, batch=8, **more)
    k = jax.random.split(jax.random.key(0), 3)
    action = jax.random.uniform(k[0], (8, 1, 2, 2), minval=-1.0)
    zeros, one = jnp.zeros((8, 2)), jnp.ones((8, 1), bool)
    x = jax.random.normal(k[1], (8, 2, 2, 3))
    new = []
    for spec in (SPEC, replace(SPEC, action_low=2.0, action_high=8.0)):
        state = learner.init(k[2], spec, config, None, None, None)
        plain = Normaliser(jnp.zeros(3), jnp.ones(3), jnp.zeros((1, 3)), jnp.ones((1, 3)), 0, "displacement")
        state["frozen"] = {"normaliser": plain}
        batch = Batch(x, action, zeros == 0, zeros[:, 0], zeros, jnp.ones((8, 1, 2)), ~one)
        new.append(jax.jit(learner.make_update(config, spec, None, None))(state, batch, k[2])[0]["params"])
    for a, b in zip(*map(jax.tree.leaves, new)):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4)


def test_threshold_of_the_multiplier():
    """A limit of one per episode, spread evenly, costs Σ γ^t / T in discounted value."""
    config = td3bc.Config(limit=3.0)
    expected = 3.0 / 25 * sum(0.95**t for t in range(25))
    assert td3bc.threshold(config, SPEC) == pytest.approx(expected)
    assert td3bc.threshold(td3bc.Config(limit=3.0, discount=1.0), SPEC) == 3.0


def one_lesson(cost: float, charged: tuple[float, ...], multiplier: float = 1.0) -> tuple[dict, dict]:
    """(state before, state after) one update of a Lagrangian learner whose cost critics say `cost` of everything,
    on steps whose present state was arrived in at a charge of `charged` each."""
    # The critics stand still, so that only actors and multipliers move.
    config, b = td3bc.Config(lagrange=True, width=4, batch=4, lr=0.0, limit=1.0, multiplier_rate=0.5), len(charged)
    k = jax.random.split(jax.random.key(0), 3)
    state = td3bc.init(k[0], SPEC, config, None, None, None)
    blank = jax.tree.map(jnp.zeros_like, state["params"]["cost"])
    said = eqx.tree_at(lambda c: c.out_bias, blank, jnp.full_like(blank.out_bias, cost))
    state["params"]["cost"] = state["target"]["cost"] = said
    plain = Normaliser(jnp.zeros(3), jnp.ones(3), jnp.zeros((1, 3)), jnp.ones((1, 3)), 0, "displacement")
    state |= {"frozen": {"normaliser": plain}, "multiplier": jnp.full(2, multiplier)}
    costs = jnp.stack([jnp.asarray(charged), jnp.zeros(b)], 1)
    batch = Batch(
        jax.random.normal(k[1], (b, 2, 2, 3)),
        jax.random.uniform(k[2], (b, 1, 2, 2), minval=-1.0),
        jnp.ones((b, 2), bool),
        jnp.zeros(b),
        costs,
        jnp.ones((b, 1, 2)),
        jnp.zeros((b, 1), bool),
    )
    return state, jax.jit(td3bc.make_update(config, SPEC, None, None))(state, batch, k[0])


def test_the_multiplier_hears_of_states_where_nothing_was_charged():
    """λ moves by η (C/d − 1), read on calm and on first states; a log that is in danger throughout says nothing."""
    allowed = td3bc.threshold(td3bc.Config(limit=1.0), SPEC)
    for cost, charged, expected in (
        (3 * allowed, (0.0, -1.0, 0.0, 0.0), 1.0 + 0.5 * 2),
        (3 * allowed, (0.0, 1.0, 1.0, 1.0), 1.0 + 0.5 * 2),
        (3 * allowed, (1.0, 1.0, 1.0, 1.0), 1.0),
        (-3 * allowed, (0.0, 0.0, 0.0, 0.0), 1.0 - 0.5),  # a cost is never negative
    ):
        _, (after, metrics) = one_lesson(cost, charged)
        np.testing.assert_allclose(after["multiplier"], expected, rtol=1e-5)
    # λ is bounded from both sides
    assert float(one_lesson(1e4, (0.0,))[1][0]["multiplier"].max()) == td3bc.Config().multiplier_max
    assert float(one_lesson(0.0, (0.0,), 0.1)[1][0]["multiplier"].min()) == 0.0


def test_targets_of_costs_are_not_negative():
    """The cost critic's goal bootstraps through max(C, 0)."""
    for cost, later in ((-2.0, 0.0), (2.0, 2.0)):
        _, (_, metrics) = one_lesson(cost, (0.0, 0.0, 0.0))
        error = (cost - 0.95 * later) ** 2  # nothing charged: the goal is γ max(C', 0)
        np.testing.assert_allclose(metrics["loss/cost"], 2 * 2 * error, rtol=1e-5)  # agents, heads


@pytest.mark.parametrize(
    "check, config, word",
    [
        (td3bc.check, td3bc.Config(limit=-1.0), "limit"),
        (td3bc.check, td3bc.Config(horizon=4), "horizon"),
        (omar.check, omar.Config(search="elites", elites=11), "elites"),
        (omar.check, omar.Config(search="elites", elites=1), "elites=1 must be 2 to 10"),
        (omar.check, omar.Config(cql_actions="policy", cql_noise=0.0), "cql_noise=0"),
        (fisor.check, fisor.Config(diffusion_steps=1), "at least 2 diffusion steps"),
        (icbf.check, icbf.Config(snr_floor=6.0), "snr_floor=6.0 is above snr_ceiling=1.0"),
        (icbf.check, icbf.Config(barrier_start=0.6), "barrier_start=0.6 is above barrier_full=0.5"),
    ],
)
def test_bad_settings_are_refused(check, config, word):
    with pytest.raises(UserError, match=word):
        check(config, None)


@pytest.mark.parametrize(
    "config, changes",
    [
        (td3bc.Config, {"alpha": -1.0}),
        (td3bc.Config, {"multiplier_rate": -0.1}),
        (td3bc.Config, {"multiplier_max": -1.0}),
        (omar.Config, {"search_iterations": 0}),
        (omar.Config, {"cql_samples": 0}),
        (Settings, {"value_updates": 0}),
        (icbf.Config, {"clip": 0.0}),
        (td3bc.Config, {"delay": 0}),
        (omar.Config, {"coefficient": 1.5}),
        (fisor.Config, {"expectile_reward": 1.0}),
        (fisor.Config, {"candidates": 0}),
    ],
)
def test_settings_out_of_range_are_refused(config, changes):
    with pytest.raises(UserError, match=rf"{next(iter(changes))}=-?[\d.]+ of it must (be at least|be positive|lie )"):
        build_config(config, changes, "it")


def test_a_bound_of_zero_on_gradients_is_none():
    optimiser = Optimiser(0.1, 0, 10, clip=0.0, floor=1.0)
    params = {"net": jnp.ones(3)}
    kept = optimiser.init(params)
    for _ in range(2):  # the rate of the first update of a warm-up is 0
        params, kept, _ = optimiser.update({"net": jnp.array([5.0, -7.0, 0.0])}, kept, params)
    assert (np.asarray(params["net"] != 1.0) == [True, True, False]).all()


def test_a_run_takes_the_preset_of_its_data(small_store):
    task = registry.from_store(small_store)
    assert make_job("omar", task, None, {}).preset == task.tier
    assert make_job("omar", task, "default", {}).preset == "default"
    assert make_job("bc", task, None, {}).preset == "default"
