"""Logs of many drivers: found without labels, and followed one at a time."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ringfence import algos
from ringfence.algos import drivers, flow
from ringfence.deploy.export import Step, metadata_of
from ringfence.errors import UserError
from ringfence.evaluation.certificate import digest
from ringfence.loading.resolve import load, resolve
from ringfence.loading.spec import PolicySpec
from ringfence.logs.store import EpisodeStore
from ringfence.logs.windows import WindowData, at
from ringfence.proposals.guidance import guided
from ringfence.proposals.options import PlanOptions, plan_defaults
from ringfence.training import loop, worlds
from ringfence.types import Spec, act_with
from ringfence.world import load as load_world
from tests.quick import QUICK_WORLD

EPISODES, LENGTH = 200, 10
SMALL = dict(num_updates=400, batch=64, width=32, depth=2, drivers=2, history=4, horizon=5, lr=3e-3, ema=0.95)


@pytest.fixture(scope="module")
def two_drivers():
    """Two agents that both push as one of two drivers does: up, or down; nothing in a state tells which."""
    rng = np.random.default_rng(0)
    driver = np.arange(EPISODES) % 2
    seen = rng.normal(size=(EPISODES, LENGTH + 1, 2, 3)).astype(np.float32)
    push = np.where(driver, 0.7, -0.7)[:, None, None, None]
    actions = np.clip(push + 0.1 * rng.normal(size=(EPISODES, LENGTH, 2, 1)), -1, 1).astype(np.float32)
    rewards = np.broadcast_to(driver[:, None], (EPISODES, LENGTH)).astype(np.float32)
    costs = np.zeros((EPISODES, LENGTH), np.float32)
    costs[::7, 3] = 1.0
    return EpisodeStore.from_episodes(seen, actions, rewards, costs, card={"task": "two-drivers"})


@pytest.fixture(scope="module")
def run(two_drivers, tmp_path_factory):
    out = tmp_path_factory.mktemp("flow")
    return loop.train("flow", two_drivers, out=out, changes={**SMALL, "condition": "return"}, quiet=True)[0]


def played(policy, steps: int = 3, batch: int = 64, entries: int = 3) -> np.ndarray:
    """Actions (B, steps, N) at the same kind of states."""
    carry = policy.initial_state(batch)
    act = jax.jit(act_with)
    out = []
    for t in range(steps):
        seen = jax.random.normal(jax.random.key(t), (batch, 2, entries))
        carry, step = act(policy, carry, seen, None, jax.random.key(10 + t))
        out.append(np.asarray(step.action)[..., 0])
    return np.stack(out, 1)


def test_an_episode_is_played_as_one_driver(run):
    """Neither their mean nor a change of mind: all agents and steps of an episode push one way, and both ways occur."""
    acts = played(load(run, cfg_scale=1.0, target_return=0.0)[1])
    assert (np.abs(acts) > 0.4).mean() > 0.95
    up = (acts > 0).reshape(len(acts), -1)
    assert (up.all(1) | (~up).all(1)).mean() > 0.9
    assert 0.2 < up.mean() < 0.8


def test_drivers_are_found_without_labels(run, two_drivers):
    assert run.metrics[-1]["drivers/sure"] > 0.95 and drivers.found(run.metrics[-1]) == 2
    store = two_drivers
    policy = load(run, cfg_scale=1.0, target_return=0.0)[1]
    first = np.asarray(eqx.filter_jit(policy.draw)(jnp.zeros((2, 2, 3)), jnp.arange(2), jax.random.key(0)))[:, 0, 0]
    assert first.min() < -0.4 and first.max() > 0.4, "one driver each"
    assert store.card.extra == {}, "nobody said who drives"


def test_steps_outside_an_episode_are_left_out(two_drivers):
    data = WindowData(two_drivers, lambda seen, state: seen)
    batch = at(data.arrays, jnp.array([0, 4, LENGTH - 1, LENGTH]), 5, 4)
    there = np.asarray(drivers.steps_there(batch))
    np.testing.assert_array_equal(there.sum(1), [4, 8, 5, 4])
    assert not there[0, :4].any() and there[0, 4:].all() and there[2, :5].all() and not there[2, 5:].any()


def test_one_driver_is_found_where_there_is_one():
    """Following one of clones that differ by chance saves nothing; of clones of two drivers, nearly all there is."""
    key = jax.random.key(0)
    there = jnp.ones((64, 12), bool)
    noise = 0.1 * jax.random.normal(key, (64, 12, 1))
    alike = jnp.zeros((64, 12, 2, 1)) + 0.01 * jax.random.normal(key, (1, 1, 2, 1))
    even = jnp.full((64, 2), 0.5)
    assert drivers.worth(alike, noise, there, even) < 0.01
    which = jnp.arange(64) % 2
    apart = jnp.broadcast_to(jnp.array([-0.7, 0.7])[:, None], (64, 12, 2, 1))
    sure = jax.nn.one_hot(which, 2)
    pays = drivers.worth(apart, noise + jnp.array([-0.7, 0.7])[which][:, None, None], there, sure)
    assert pays > 0.9
    told = {"drivers/worth": float(pays), "drivers/distinguished": float(drivers.distinguished(sure))}
    assert drivers.found(told) == 2 and drivers.found(told | {"drivers/worth": -0.1}) == 1


def test_shares_are_balanced():
    """Rows add up to one; a driver who explains all windows a little better does not get them all."""
    explained = jax.random.normal(jax.random.key(0), (40, 4)) + jnp.array([5.0, 0.0, 0.0, 0.0])
    shares = np.asarray(jax.jit(drivers.balanced)(explained))
    np.testing.assert_allclose(shares.sum(1), 1.0, atol=1e-5)
    np.testing.assert_allclose(shares.sum(0), 10.0, rtol=0.05)


def test_drivers_that_nobody_needs_are_left(two_drivers, tmp_path):
    """With six for two, balance alone would give each a sixth: two explain all windows, and only they are drawn."""
    search = drivers.Search(4, num_updates=100, settled=0.5)
    explained = jnp.zeros((40, 4)).at[:, 0].set(9.0)
    shares = jax.jit(drivers.shares_of, static_argnums=0)
    early, late = (np.asarray(shares(search, explained, step)).mean(0) for step in (0, 60))
    np.testing.assert_allclose(early, 0.25, atol=0.02)
    np.testing.assert_allclose(late, [1.0, 0.0, 0.0, 0.0], atol=0.01)
    run = loop.train("flow", two_drivers, out=tmp_path, changes={**SMALL, "drivers": 6}, quiet=True)[0]
    acts = played(load(run)[1])
    assert (np.abs(acts) > 0.4).mean() > 0.9


@pytest.mark.parametrize("count", [1, 3])
def test_a_guard_gets_as_many_proposals_as_it_asks_for(run, two_drivers, count):
    """The first is the episode's own driver's, however many there are; a shield asks for one."""
    policy = load(run)[1]
    world = worlds.fit(two_drivers, **QUICK_WORLD, barrier=False)
    x = jnp.asarray(two_drivers.observations[:4])
    carry, plans, _ = eqx.filter_jit(policy.propose)(
        policy.initial_state(4), x, None, jax.random.key(0), count, 2, world
    )
    assert plans.shape == (4, count, 2, 2, 1)
    again, action = eqx.filter_jit(policy.act)(policy.initial_state(4), x, None, jax.random.key(0))
    np.testing.assert_array_equal(carry["driver"], again["driver"])
    assert np.isfinite(plans).all()


@pytest.mark.parametrize(
    "options, said",
    [
        ({"replan": 2}, "replan=2 is about plans of states"),
        ({"sampler": "ddpm"}, "sampler=ddpm is about plans of states"),
        ({"value_guidance": 0.5}, "value_guidance=0.5 is about plans of states"),
    ],
)
def test_options_of_plans_of_states_are_refused(run, options, said):
    with pytest.raises(UserError, match=said):
        load(run, **options)


def test_a_target_that_nothing_reads_is_refused(two_drivers, tmp_path):
    run = loop.train("flow", two_drivers, out=tmp_path, changes={**SMALL, "num_updates": 4}, quiet=True)[0]
    with pytest.raises(UserError, match="the run was trained with condition='none'"):
        load(run, target_return=2.0)
    load(run)


def test_more_drivers_than_windows_are_refused(two_drivers, tmp_path):
    with pytest.raises(UserError, match="drivers=65 share 64 windows"):
        loop.train("flow", two_drivers, out=tmp_path, changes={**SMALL, "drivers": 65}, quiet=True)


def test_the_return_chooses_who_drives(run):
    """Whoever pushes up earns all there is to earn: that driver is drawn for a high return, the other for a low one."""
    much, little = (played(load(run, target_return=y)[1]) for y in (0.7, -0.7))
    assert (much > 0).mean() > 0.9 and (little < 0).mean() > 0.9


def test_proposals_are_of_several_drivers(run, two_drivers):
    world = worlds.fit(two_drivers, **QUICK_WORLD)
    policy = load(run, cfg_scale=1.0, target_return=0.0)[1]
    seen = jnp.zeros((5, 2, 3))
    carry, actions, _ = eqx.filter_jit(policy.propose)(
        policy.initial_state(5), seen, None, jax.random.key(0), 9, 2, world
    )
    assert actions.shape == (5, 9, 2, 2, 1)
    ways = np.asarray(actions)[:, :, 0, 0, 0]
    assert ((ways.max(1) > 0.4) & (ways.min(1) < -0.4)).all()


@pytest.fixture(scope="module")
def two_drifts(two_drivers):
    """As `two_drivers`, but an action moves what is seen of an agent, so that plans of states say what is done."""
    pushed = np.cumsum(two_drivers.actions.reshape(EPISODES, LENGTH, 2, 1), 1)
    begun = np.random.default_rng(1).normal(size=(EPISODES, 1, 2, 1))
    seen = np.concatenate([begun, begun + pushed], 1).astype(np.float32)
    actions = two_drivers.actions.reshape(EPISODES, LENGTH, 2, 1)
    rewards = two_drivers.rewards.reshape(EPISODES, LENGTH, 2)
    costs = np.zeros((EPISODES, LENGTH), np.float32)
    return EpisodeStore.from_episodes(seen, actions, rewards, costs, card={"task": "two-drifts"})


PLANS = dict(num_updates=300, batch=32, width=32, depth=2, horizon=5, diffusion_steps=20, inverse_width=32, ema=0.95)


def test_plans_of_states_are_of_one_driver(two_drifts, tmp_path):
    """Told the drivers, a planner goes one way through an episode, and both ways occur; guards get plans of both."""
    changes = PLANS | {"net": "residual", "drivers": 2}
    run = loop.train("madiff", two_drifts, out=tmp_path, changes=changes, world=QUICK_WORLD, quiet=True)[0]
    assert run.metrics[-1]["drivers/sure"] > 0.95
    policy = load(run, cfg_scale=1.0, target_return=0.0)[1]
    acts = played(policy, entries=1)
    up = (acts > 0).reshape(len(acts), -1)
    assert (up.all(1) | (~up).all(1)).mean() > 0.7  # a quarter by chance
    assert 0.2 < up.mean() < 0.8
    world = worlds.fit(two_drifts, **QUICK_WORLD)
    seen = jnp.zeros((5, 2, 1))
    _, actions, _ = eqx.filter_jit(policy.propose)(policy.initial_state(5), seen, None, jax.random.key(0), 9, 2, world)
    ways = np.asarray(actions)[:, :, 0, 0, 0]
    assert ((ways.max(1) > 0.3) & (ways.min(1) < -0.3)).all()


@pytest.mark.parametrize(
    "changes, said",
    [
        ({"net": "unet"}, "drivers=2 are given to a plan of the whole team"),
        ({"observe": "single"}, "drivers=2 are given to a plan of the whole team"),
        ({"drivers": 33}, "drivers=33 share 32 windows"),
        ({"net": "unet", "drivers": 0, "distinguish_agents": True}, "distinguish_agents is of the net attention"),
    ],
)
def test_plans_that_drivers_cannot_be_told_to_are_refused(two_drifts, tmp_path, changes, said):
    with pytest.raises(UserError, match=said):
        loop.train("madiff", two_drifts, out=tmp_path, changes=PLANS | {"drivers": 2} | changes, quiet=True)


def test_agents_are_told_apart_where_asked(two_drifts, tmp_path):
    changes = PLANS | {"num_updates": 4, "net": "attention"}
    for apart in (False, True):
        asked = dict(changes=changes | {"distinguish_agents": apart}, out=tmp_path / str(apart), world=QUICK_WORLD)
        denoiser = load(loop.train("madiff", two_drifts, quiet=True, **asked)[0])[1].networks["denoiser"]
        assert (denoiser.which is not None) == apart
    assert np.abs(denoiser.which).max() > 0, "it is learned"


class Seen:
    """The view of who sees the observation as it is."""

    names = ("obs0",)

    def __call__(self, observations, state):
        return observations


class Line(eqx.Module):
    """A World where an action moves a place by itself, and places above −0.5 lack the margin by as much."""

    spec: Spec = eqx.field(static=True)
    ood_threshold: float = 1.0
    edge: float = 0.5
    card = SimpleNamespace(barrier=None)

    @property
    def dynamics(self):
        return self

    @property
    def barrier(self):
        return self

    def step(self, x, action):
        return x + action, jnp.zeros(x.shape[:-1])

    def apart(self, before, after):
        return self.edge - after

    def ahead_apart(self, x):
        return self.edge - x

    @property
    def map(self):
        return Seen()


def paid(store):
    """The same logs with some costs."""
    costs = np.zeros(store.rewards.shape[:1], np.float32)
    costs[::7] = 1.0
    return dataclasses.replace(store, costs=costs)


def test_guidance_moves_actions_to_the_margin(two_drifts, tmp_path):
    """Polyak's step is exact where scores are linear and agents lack the same, whatever danger weighs; what keeps the
    margin is left as it is."""
    changes = SMALL | {"num_updates": 20}
    run = loop.train("flow", two_drifts, out=tmp_path, changes=changes, quiet=True)[0]
    policy = load(run)[1]
    x = jnp.zeros((4, 2, 1))
    driver = jnp.zeros(4, jnp.int32)

    def drawn(weight, present, steps=1):
        options = PlanOptions(sampling_steps=steps, temperature=0.0)
        asked = guided(dataclasses.replace(policy, options=options), Line(policy.spec), 0.0, weight)
        return np.asarray(eqx.filter_jit(asked.draw)(x, driver, jax.random.key(0), present))

    free = drawn(0.0, x)
    assert free.mean() > -0.5
    for weight in (1.0, 10.0):
        np.testing.assert_allclose(drawn(weight, x).mean(), -0.5, atol=1e-4)
    np.testing.assert_array_equal(drawn(1.0, x - 2.0), free)
    np.testing.assert_allclose(drawn(1.0, x, steps=4).max(), -0.5, atol=0.05)


def test_flow_learns_to_keep_the_margin(two_drifts, tmp_path, monkeypatch):
    """With λ the drivers' means end where danger keeps its margin, though half of the logs go beyond; a World is read
    while training alone."""
    line = Line(None)
    known = {"dynamics": line, "barrier": line, "ood_threshold": line.ood_threshold}
    monkeypatch.setattr(flow, "from_world", lambda world, config: known if flow.follows(config) else {})
    changes = SMALL | {"barrier_weight": 3.0, "num_updates": 200}
    run = loop.train("flow", paid(two_drifts), out=tmp_path, changes=changes, world=QUICK_WORLD, quiet=True)[0]
    policy = load(run, sampling_steps=1, temperature=0.0)[1]
    x = jnp.zeros((8, 2, 1))
    for driver in range(2):
        ends = x + eqx.filter_jit(policy.draw)(x, jnp.full(8, driver), jax.random.key(0))
        assert ends.max() < -0.3, "the drivers push by 0.7, up or down"


def test_guidance_reads_the_world_that_is_given(two_drifts, run, tmp_path):
    changes = SMALL | {"num_updates": 4}
    flows = loop.train("flow", two_drifts, out=tmp_path, changes=changes, quiet=True)[0]
    world = worlds.fit(two_drifts, **QUICK_WORLD)
    with pytest.raises(UserError, match="needs a World that knows danger"):
        load(flows, barrier_guidance=1.0, world=world, anyway=True)
    with pytest.raises(UserError, match="is unfit to guard by"):
        load(flows, barrier_guidance=1.0, world=world)
    with pytest.raises(UserError, match="world is read by nothing"):
        load(flows, world=world)


def test_plans_are_guided_to_the_margin(two_drifts, tmp_path, caplog):
    """Guided plans stay where danger keeps its margin; what keeps it is left as it is. A World that is unfit guides
    nobody by itself."""
    run = loop.train("icbf", paid(two_drifts), out=tmp_path, changes=PLANS, world=QUICK_WORLD, quiet=True)[0]
    policy = load(run)[1]
    assert policy.guide is None and "unfit to guide by, so plans are drawn without it" in caplog.text
    seen = jnp.zeros((16, 2, 1))

    def ends(policy):
        step = eqx.filter_jit(policy.act)(policy.initial_state(16), seen, None, jax.random.key(0))[1]
        return np.asarray(step.action)[..., 0]

    free = ends(policy)
    kept = ends(guided(policy, Line(policy.spec, edge=1.5), 0.0, 10.0))
    assert free.max() > 0.7 and kept.max() < 0.5
    far = Line(policy.spec, ood_threshold=1.0, edge=9.0)
    np.testing.assert_allclose(ends(guided(policy, far, 0.0, 10.0)), free, atol=1e-6)
    step = Step(lambda: [], (), (), {}, lambda key: [])
    told = [
        metadata_of(resolve(PolicySpec.of(run, **how)), step) for how in ({}, {"barrier_guidance": 1.0, "anyway": True})
    ]
    digests = [None, digest(load_world(run.path / worlds.WORLD))]
    assert [(one["guiding_world"], one["world"]) for one in told] == [(one, None) for one in digests]


@pytest.mark.parametrize("name", ["madiff", "flow"])
def test_a_raw_return_is_asked_for_on_its_own_scale(name):
    algorithm = algos.get(name)
    ranked, raw = (algos.configured(algorithm, "default", {"condition": y}) for y in ("return", "raw"))
    assert plan_defaults(raw) == plan_defaults(ranked) | {"target_return": 0.9}
