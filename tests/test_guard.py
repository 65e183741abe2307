"""The guard: what it does with proposals, whoever makes them."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import msgspec
import numpy as np
import pytest

import ringfence
from ringfence import world
from ringfence.datasets import registry
from ringfence.deploy.controller import Controller
from ringfence.errors import UserError
from ringfence.evaluation.evaluate import evaluate
from ringfence.guards import BarrierSource, Guard, GuardOptions
from ringfence.guards.correction import ASKED, Corrector, continuations, fixed_plans
from ringfence.guards.filter import pick
from ringfence.guards.policy import build
from ringfence.guards.shown import Shown
from ringfence.loading.resolve import load
from ringfence.problem import constraints
from ringfence.proposals.base import Constant
from ringfence.training import loop, worlds
from ringfence.world.card import Avoidable, BarrierScores, Card, Verdict
from ringfence.world.verdict import look_of
from tests.quick import QUICK_WORLD


@pytest.fixture(scope="module")
def bound(small_world):
    return constraints.bind(constraints.Separation(), small_world.spec.feature_names, 3)


def make(world, bound, source="analytic", **options) -> Guard:
    return Guard(BarrierSource(world, source, bound, False), GuardOptions(**options))


@pytest.fixture(scope="module")
def present(small_store, small_world):
    return jnp.asarray(small_world.map(small_store.observations, small_store.state)[:64])


def test_the_shield_corrects_what_falls_short_and_nothing_else(small_world, bound, present):
    """Actions are left alone where the plan keeps its margin, and otherwise lead to more clearance, within bounds."""
    plan = jnp.zeros((64, 3, 3, 2))
    last = jnp.zeros_like(plan)
    found = {}
    for name, margin in (("easy", -90.0), ("hard", 4.0)):
        guard = make(small_world, bound, correction_steps=8)
        found[name] = eqx.filter_jit(guard.decide)(
            present, plan[:, None], last, jnp.full((64, 1), margin), jax.random.key(0)
        )
    np.testing.assert_array_equal(found["easy"].plan, plan)
    assert not found["easy"].short.any()
    assert np.abs(found["hard"].plan).max() <= 1.0
    short = np.asarray(found["easy"].safety.min(-1)) < 4.0
    assert 5 < short.sum()
    assert (found["hard"].safety.min(-1) - found["easy"].safety.min(-1))[short].mean() > 0
    assert found["hard"].short.any()  # what cannot be met is said


def missing(guard, present, plan, margin):
    """(B, K, N) of the condition along plans."""
    rows, spread = guard.predict(present, plan[:, None])
    return guard.missing(present, guard.clear(rows, spread, margin)[:, 0], margin)


@eqx.filter_jit
def shielded(guard, present, plan, margin):
    return guard.shielded(present, plan, missing(guard, present, plan, margin), margin)


def test_the_shield_never_makes_it_worse(small_world, bound, present):
    guard = make(small_world, bound, correction_steps=3)
    plan = jax.random.uniform(jax.random.key(5), (64, 3, 3, 2), minval=-1, maxval=1)
    margin = jnp.full((64, 1), 3.0)
    before, after = (missing(guard, present, p, margin) for p in (plan, shielded(guard, present, plan, margin)))
    assert (after.sum((1, 2)) >= before.sum((1, 2)) - 1e-5).all()


def test_a_correction_that_falls_short_is_begun_again(small_world, bound, present):
    """No plan becomes worse, some become better, and none leaves its bounds."""
    plan = jax.random.uniform(jax.random.key(5), (64, 3, 3, 2), minval=-0.3, maxval=0.3)
    margin = jnp.full((64, 1), 3.0)
    left = {}
    for restarts in (0, 1):
        guard = make(small_world, bound, correction_steps=3, correction_restarts=restarts, max_correction=0.8)
        found = shielded(guard, present, plan, margin)
        assert (jnp.abs(found - plan) <= 0.8 + 1e-6).all() and (jnp.abs(found) <= 1).all()
        left[restarts] = np.asarray(missing(guard, present, found, margin).sum((1, 2)))
    assert (left[1] >= left[0] - 1e-5).all()
    assert (left[1] > left[0] + 1e-2).any()


@pytest.mark.parametrize("dim", [1, 2, 3, 6])
def test_every_agent_begins_from_every_fixed_plan(dim):
    plans = fixed_plans(rows=3, agents=2, dim=dim, rounds=2)
    many = plans.shape[1]
    assert plans.shape == (2, many, 3, 2, dim) and many <= 1 + 26 * 3 * 2
    sets = [np.unique(plans[r, :, :, n].reshape(many, -1), axis=0) for r in range(2) for n in range(2)]
    assert all(np.array_equal(sets[0], one) for one in sets)
    assert np.abs(plans).max() == 1.0 and (plans == 0).all((2, 3, 4)).sum() < many
    if dim <= 3:  # into each direction by all that an agent can do, for all rows
        for corner in ([1.0] * dim, [-1.0] * dim):
            assert (plans[0, :, :, 0] == np.array(corner)).all((1, 2)).any()


@pytest.mark.parametrize("speed, kept", [(0.0, True), (0.25, False)])
def test_what_was_asked_for_is_held_for_a_few_rows_and_not_for_all(speed, kept):
    """Pushed for 15 rows everybody is too fast: that is no reason not to push now, as long as there is a way out."""

    def missing(speed, plans, margin):  # (B, S, K, N) of agents that may not be faster than 0.5
        fast = speed + 0.1 * jnp.cumsum(plans[..., 0], 2)
        return jnp.minimum(0.5 - jnp.abs(fast), 0.0)

    def within(present, plan):
        return -jnp.ones_like(plan), jnp.ones_like(plan)

    correct = Corrector(missing, within, alone=False, steps=10, restarts=1)
    asked = jnp.ones((1, 15, 2, 1))
    found = correct(jnp.full((1, 1, 1, 1), speed), asked, missing(speed, asked[:, None], None)[:, 0], jnp.ones((1, 1)))
    assert (missing(speed, found[:, None], None) >= -1e-3).all()
    assert ((found[:, :ASKED] == 1.0).all()) == kept
    plans = continuations(rows=12, agents=2, dim=2)
    assert plans.shape == (1 + 8 * 2, 12, 2, 2) and (plans[:, 6:] == 0).all((1, 2, 3)).sum() < len(plans) // 2


def test_what_is_near_counts_for_more_where_no_plan_meets_all():
    """A push now costs 0.3 in the first row, none costs 0.1 in each of the last five."""

    def missing(present, plans, margin):
        pushed = jnp.clip(plans[..., 0, :, 0], 0.0, 1.0)[..., None, :]
        rows = jnp.arange(15)[:, None]
        return -jnp.where(rows == 0, 0.3 * pushed, jnp.where(rows > 9, 0.1 * (1 - pushed), 0.0))

    def within(present, plan):
        return -jnp.ones_like(plan), jnp.ones_like(plan)

    correct = Corrector(missing, within, alone=False, steps=10, restarts=1)
    asked = jnp.ones((1, 15, 1, 1))
    found = correct(jnp.zeros(1), asked, missing(None, asked[:, None], None)[:, 0], jnp.ones((1, 1)))
    assert found[0, 0, 0, 0] <= 0


def test_many_plans_are_corrected_as_few_are(small_world, bound, present):
    """Those who need it, a few at a time; their number is no multiple of anything."""
    guard = make(small_world, bound, correction_steps=4)
    plan = jax.random.uniform(jax.random.key(6), (45, 3, 3, 2), minval=-1, maxval=1)
    margin = jnp.linspace(-1.0, 3.0, 45)[:, None]
    several = shielded(guard, present[:45], plan, margin)
    each = [shielded(guard, present[k : k + 9], plan[k : k + 9], margin[k : k + 9]) for k in range(0, 45, 9)]
    np.testing.assert_allclose(several, jnp.concatenate(each), atol=1e-4)
    moved = (several != plan).any((1, 2, 3))
    assert 0 < moved.sum() < 45


def test_refining_climbs_value(small_world, bound, present):
    guard = make(small_world, bound, optimizer_steps=10, num_restarts=4, safety_weight=0.0)
    plan = jnp.zeros((64, 1, 3, 3, 2))
    value = jax.jit(lambda a: small_world.values.of_plan(guard.predict(present, a)[0], a))
    better = eqx.filter_jit(guard.refined)(present, plan, -jnp.ones_like(plan), jnp.ones_like(plan), jnp.zeros((64, 1)))
    assert (value(better) > value(plan)).mean() > 0.9 and jnp.abs(better).max() <= 1
    last = jnp.full((64, 3, 3, 2), 0.5)
    starts = eqx.filter_jit(guard.started)(plan, last, jax.random.key(0))[0]
    assert starts.shape[1] == 4
    np.testing.assert_array_equal(starts[:, 0], plan[:, 0])
    assert (starts[:, 1] == 0.5).all()  # the last plan, moved on
    assert (jnp.abs(starts[:, 2:]) > 0.5).any()  # noisy copies


def test_refining_stays_within_reach_of_its_proposal(small_world, bound, present):
    guard = make(small_world, bound, optimizer_steps=10, num_restarts=6, num_samples=2, trust_radius=0.1)
    plan = jnp.stack([jnp.full((64, 3, 3, 2), v) for v in (0.0, 0.95)], 1)
    last = jnp.full((64, 3, 3, 2), 0.5)
    starts, low, high = eqx.filter_jit(guard.started)(plan, last, jax.random.key(0))
    better = eqx.filter_jit(guard.refined)(present, starts, low, high, jnp.zeros((64, 1)))
    for found in (starts, better):
        near = [jnp.abs(found - plan[:, k : k + 1]).max((2, 3, 4)) <= 0.1 + 1e-6 for k in range(2)]
        np.testing.assert_array_equal(jnp.argmax(jnp.stack(near), 0)[0], [0, 1, 0, 0, 1, 0])
        assert (near[0] | near[1]).all() and jnp.abs(found).max() <= 1
    assert jnp.abs(better - starts).max() > 0.05


@pytest.mark.parametrize(
    "avoided, kept, options, future",
    [
        ([0.2, 0.2, 0.9], 0.97, {}, True),
        ([0.2, 0.6, 0.9], 0.97, {}, True),
        ([0.2, 0.88, 0.9], 0.97, {}, False),
        ([0.2, 0.2, 0.9], 0.5, {}, False),
        ([0.2, 0.2, 0.9], 0.97, {"horizon": 7}, False),
        ([0.2, 0.2, 0.9], 0.97, {"terminal_value": False}, False),
    ],
)
def test_a_guard_looks_as_far_as_the_card_says(small_world, avoided, kept, options, future):
    """Where three rows come too late, the value of danger judges the last one, unless it calls most safe steps lost, or
    something else is asked for."""
    avoidable = Avoidable(before=(1, 3, 15), avoided=tuple(avoided), rows=15)
    card = Card(data=small_world.card.data, barrier=BarrierScores(ahead_kept=kept, avoidable=avoidable))
    card = msgspec.structs.replace(card, look=look_of(card))
    world = dataclasses.replace(small_world, card=card)
    for policy in (ringfence.guard(lambda seen, state: 0, world, **options).policy.guarded,
                   ringfence.guard(Constant(world.spec), world, **options)):  # fmt: skip
        assert policy.guard.barrier.terminal_value == policy.guard.options.terminal_value == future
    assert not build(Constant(world.spec), world, None, "shield", "learned", {}, **options).guard.options.terminal_value


def test_a_horizon_in_seconds_is_one_in_steps(small_world):
    def horizon(dt, **options):
        data = msgspec.structs.replace(small_world.card.data, dt=dt)
        world = dataclasses.replace(small_world, card=msgspec.structs.replace(small_world.card, data=data))
        return ringfence.guard(Constant(world.spec), world, anyway=True, **options).guard.options.horizon

    assert horizon(0.1, horizon_seconds=1.5) == 15
    assert horizon(0.4, horizon_seconds=0.1) == 1
    assert horizon(None, horizon=4) == 4
    with pytest.raises(UserError, match="horizon_seconds=2 needs a World of logs whose card says how long a step is"):
        horizon(None, horizon_seconds=2.0)
    with pytest.raises(UserError, match="horizon=4 and horizon_seconds=2.0 both say how far the guard looks"):
        horizon(0.1, horizon=4, horizon_seconds=2.0)
    with pytest.raises(UserError, match="horizon_seconds=-1"):
        horizon(0.1, horizon_seconds=-1.0)


def test_the_shield_stays_within_its_bound(small_world, bound, present):
    """Even where that is not enough, which is counted as always."""
    guard = Guard(
        BarrierSource(small_world, "analytic", bound, False), GuardOptions(correction_steps=10, max_correction=0.1)
    )
    plan = jnp.full((64, 3, 3, 2), 0.95)
    margin = jnp.full((64, 1), 9.0)
    kept = shielded(guard, present, plan, margin)
    moved = jnp.abs(kept - plan)
    assert 0.05 < moved.max() <= 0.1 + 1e-6 and jnp.abs(kept).max() <= 1
    far = shielded(make(small_world, bound, correction_steps=10), present, plan, margin)
    assert jnp.abs(far - plan).max() > 0.2


def test_who_is_not_driven_does_what_is_proposed(small_world, bound, present):
    """All of the correction is left to the one who is."""
    guard = make(small_world, bound, correction_steps=10, correction_restarts=1, horizon=5)
    asked = jax.random.uniform(jax.random.key(1), (64, 1, 1, 3, 2), minval=-1, maxval=1)
    plan = jnp.broadcast_to(asked, (64, 1, 5, 3, 2))
    driven = jnp.asarray(np.arange(3) == np.arange(64)[:, None] % 3)
    last, margin, key = jnp.zeros((64, 5, 3, 2)), jnp.full((64, 1), 3.0), jax.random.key(0)
    found = eqx.filter_jit(guard.decide)(present, plan, last, margin, key, None, driven)
    moved = (jnp.abs(found.plan - plan[:, 0]) > 0).any((1, 3))
    assert moved.any() and not (moved & ~driven).any()


def test_the_best_of_the_safe_ones_is_taken():
    safety, value = jnp.asarray([[0.0, 2.0, 3.0], [0.0, 0.1, 0.2]]), jnp.asarray([[9.0, 5.0, 1.0], [9.0, 5.0, 1.0]])
    np.testing.assert_array_equal(pick(safety, value, 1.0), [1, 2])  # the second has no safe one: the safest


def test_agents_that_are_alone_hear_of_nobody(small_store, present):
    """Nobody's action depends on what another one sees or would do."""
    world = worlds.fit(small_store, execution="decentralized", **QUICK_WORLD)
    assert world.alone and world.map.view == "decentralized"
    seen = jnp.asarray(small_store.observations[:16])
    bound = constraints.bind(constraints.Separation(), world.spec.feature_names, 3)
    guard = make(
        world, bound, correction_steps=4, correction_restarts=1, optimizer_steps=3, num_restarts=3, select=True
    )
    plan = jax.random.uniform(jax.random.key(1), (16, 2, 3, 3, 2), minval=-1, maxval=1)
    last, margin, key = jnp.zeros((16, 3, 3, 2)), jnp.ones((16, 3, 1)), jax.random.key(0)
    here = world.map(seen, None)
    decide = eqx.filter_jit(guard.decide)
    a = decide(here, plan, last, margin, key)
    b = decide(here.at[:, 1].add(0.3), plan.at[..., 1, :].set(0.9), last, margin.at[:, 1].set(2.0), key)
    np.testing.assert_allclose(a.plan[..., 0, :], b.plan[..., 0, :], atol=1e-6)
    np.testing.assert_allclose(a.plan[..., 2, :], b.plan[..., 2, :], atol=1e-6)
    assert a.chosen.shape == (16, 3)


def test_an_adapting_margin_settles_at_its_rate(small_world, bound):
    """However wrong foresight is, the share of unsafe steps tends to the chosen one (Gibbs and Candès 2021)."""
    guard = make(small_world, bound, correction_steps=1, adapt=0.2, rate=0.05)
    wrong = jnp.asarray([0.0, 0.1, 0.5])  # that foresight is off by, and tenfold in every hundredth step

    def step(margin, key):
        more, now = jax.random.split(key)
        error = wrong * jnp.abs(jax.random.normal(now, (3,))) * (1 + 9 * (jax.random.uniform(more, (3,)) < 0.01))
        unsafe = margin - error < 0  # the shield keeps what it foresees
        return guard.adapted(margin, unsafe), (margin, unsafe)

    _, (margins, unsafe) = jax.lax.scan(step, jnp.full(3, 1.0), jax.random.split(jax.random.key(0), 8000))
    np.testing.assert_allclose(unsafe[2000:].mean(0)[1:], 0.05, atol=0.01)
    kept = margins[2000:].mean(0)
    assert kept[0] < 0.05 and kept[1] < kept[2]  # no more is kept than the errors ask for
    assert float(guard.adapted(jnp.full(1, 2.99), jnp.ones(1, bool))[0]) == 3.0  # bounded


def test_a_cost_that_is_heard_moves_the_margin(small_world, bound, small_store):
    policy = build(Constant(small_world.spec), small_world, constraints.Separation(), "adapt", "analytic")
    act = eqx.filter_jit(policy.act)
    seen, state = small_store.observations[:2], small_store.state[:2]
    carry, first = act(policy.initial_state(2), seen, state, jax.random.key(0))
    assert (carry["margin"] == np.float32(0.6)).all()  # nobody chose the first state
    carry, _ = act(policy.observe_cost(carry, np.array([0.0, 1.0])), seen, state, jax.random.key(1))
    o = policy.guard.options
    expected = 0.6 + o.adapt * (np.array([0.0, 1.0]) - o.rate)
    np.testing.assert_allclose(carry["margin"][:, 0], expected, rtol=1e-5)


@pytest.mark.parametrize("guard", ["shield", "adapt"])
def test_one_program_acts_in_every_step(small_world, small_store, guard):
    """What is carried has the same types after a step as before the first, and when a cost was observed."""
    policy = build(Constant(small_world.spec), small_world, constraints.Separation(), guard, "analytic")
    carry = policy.initial_state(2)
    after, _ = jax.eval_shape(policy.act, carry, small_store.observations[:2], small_store.state[:2], jax.random.key(0))
    types = [
        jax.tree.map(lambda x: (x.shape, x.dtype, x.weak_type), later)
        for later in (carry, after, jax.eval_shape(policy.observe_cost, after, jnp.zeros(2)))
    ]
    assert types[0] == types[1] == types[2]


def test_a_controller_that_has_warmed_up_acts_as_it_would_have(small_world, small_store):
    """A callable is asked once more, nothing is recorded, and actions are the same."""
    asked = []

    def proposes(seen, state):
        asked.append(seen)
        return np.full((3, 2), 0.3)

    seen, state = small_store.observations[0], small_store.state[0]
    controllers = [ringfence.guard(proposes, small_world, guard="shield") for _ in range(2)]
    controllers[0].warm_up(small_store.observations[7], small_store.state[7])
    assert len(asked) == 1 and controllers[0].last_action is None and not controllers[0].info
    for _ in range(2):
        np.testing.assert_array_equal(*(controller.act(seen, state) for controller in controllers))


def test_where_the_world_knows_nothing_danger_is_assumed(small_world, bound, present):
    barrier = BarrierSource(small_world, "learned", None, False)
    rows = jnp.stack([present, present], 1)[:, None]
    spread = jnp.full((64, 1, 1, 3), 3.0 * small_world.ood_threshold)
    along = eqx.filter_jit(barrier.along)
    near, far = along(rows, 0.0 * spread), along(rows, spread)
    np.testing.assert_allclose(near - far, 2.0, rtol=1e-4)


def test_nothing_has_its_margin_out_of_distribution_where_a_guard_stays_within_the_logs(small_world, present):
    anywhere = Shown((-1e3,), (1e3,), (0,), (False,), ())
    barrier = BarrierSource(small_world, "learned", None, False, anywhere)
    rows = jnp.stack([present, present], 1)[:, None]
    along = eqx.filter_jit(barrier.along)
    near = along(rows, jnp.zeros((64, 1, 1, 3)))
    far = along(rows, jnp.full((64, 1, 1, 3), 3.0 * small_world.ood_threshold))
    at_the_edge = along(rows, jnp.full((64, 1, 1, 3), small_world.ood_threshold))
    assert (near > 1).any(), "any margin may be kept where it knows what happens"
    np.testing.assert_allclose(far, jnp.minimum(near, -1.0), rtol=1e-4)
    np.testing.assert_allclose(at_the_edge, jnp.minimum(near, 1.0), rtol=1e-4)


def test_entries_of_actions_that_an_agent_has_not_stay_where_they_are(small_world):
    """Whatever is proposed, climbed or corrected; the others of the same agent move."""
    spec = dataclasses.replace(small_world.spec, action_sizes=(2, 1, 2))
    world = dataclasses.replace(small_world, spec=spec)
    pilot = ringfence.guard(
        lambda *_: np.full((3, 2), 0.3),
        world,
        guard="full",
        horizon=2,
        optimizer_steps=2,
        num_restarts=3,
        num_samples=1,
        correction_steps=2,
        margin=9.0,
    )
    acted = pilot.act(*(np.zeros(k, np.float32) for k in ((3, 18), 18)))
    assert acted[1, 1] == 0 and (np.abs(np.delete(acted.ravel(), 3) - 0.3) > 1e-4).all()


def test_the_smaller_of_both(small_world, bound, present):
    rows, spread = jnp.stack([present, present], 1)[:, None], jnp.zeros((64, 1, 1, 3))
    scores = {
        s: BarrierSource(small_world, s, bound, False).along(rows, spread) for s in ("analytic", "learned", "both")
    }
    np.testing.assert_array_equal(scores["both"], jnp.minimum(scores["analytic"], scores["learned"]))


def test_any_callable_is_guarded(small_world, small_store):
    """A controller of NumPy arrays; what it may not return is said in a sentence."""
    seen, state = small_store.observations[0], small_store.state[0]
    pilot = ringfence.guard(lambda observations, state: np.zeros((3, 2)), small_world)
    assert pilot.act(seen, state).shape == (3, 2) and {"infeasible", "ood"} <= set(pilot.info)
    assert pilot.info["agent_clearance"].shape == pilot.info["agent_ood"].shape == (3,)
    assert pilot.info["clearance"] == pilot.info["agent_clearance"].min()
    assert pilot.info["infeasible"] == pilot.info["agent_infeasible"].any()
    pilot.reset()
    pilot.act(seen, state, cost=1.0)
    for wrong, said in (
        (np.full((3, 2), np.nan), "returned actions that are not finite"),
        (np.zeros((2, 2)), r"returned actions of shape \(2, 2\); this World takes \(3, 2\)"),
        ("left", "returned no array of numbers"),
    ):
        with pytest.raises(UserError, match=said):
            ringfence.guard(lambda *_, wrong=wrong: wrong, small_world).act(seen, state)
    with pytest.raises(UserError, match="needs a formula that the World's view can read"):
        ringfence.guard(lambda *_: np.zeros((3, 2)), small_world, barrier="analytic")
    with pytest.raises(UserError, match="give a callable"):
        ringfence.guard(3, small_world)
    with pytest.raises(UserError, match="for a World"):
        ringfence.guard(lambda *_: 0, None)


@pytest.mark.verdicts
def test_a_world_of_other_data_is_refused(small_store, small_world, tmp_path):
    tiny = dict(changes={"num_updates": 2, "width": 8}, quiet=True, out=tmp_path)
    run = loop.train("bc", small_store, **tiny)[0]
    data = msgspec.structs.replace(small_world.card.data, task="other")
    other = dataclasses.replace(small_world, card=msgspec.structs.replace(small_world.card, data=data))
    with pytest.raises(UserError, match="is a World of 'other', the run .* of other data"):
        load(run, guard="shield", world=other)
    with pytest.raises(UserError, match="needs the World of its data"):
        load(run, guard="shield")  # nothing that this package regenerates
    alone = worlds.fit(small_store, execution="decentralized", **QUICK_WORLD)
    with pytest.raises(
        UserError, match="fitted with execution=decentralized, the guard is to have execution=centralized"
    ):
        load(run, guard="shield", world=alone)
    unfit = msgspec.structs.replace(small_world.card, verdict=Verdict("unfit", ("it knows little",)))
    same = dataclasses.replace(small_world, card=unfit)
    with pytest.raises(UserError, match="unfit to guard by"):
        evaluate(run, episodes=2, guard="shield", world=same)
    result = evaluate(run, episodes=2, guard="shield", world=same, anyway=True)
    assert result["guard"] == "shield" and result["barrier"] == "learned" and 0 <= result["infeasible_rate"] <= 1
    assert registry.get("simple_spread-random").name == result["task"]


def test_all_proposals_of_a_task_are_judged_by_the_same_world(small_store, tmp_path, monkeypatch):
    """A planner whose training read values of its own discount is guarded by the task's World, not by those."""
    changes = dict(num_updates=2, batch=8, width=16, depth=1, barrier_batch=4, barrier_width=8)
    far, usual = (
        loop.train(
            "icbf",
            small_store,
            out=tmp_path / f"{d}",
            changes={**changes, "discount": d},
            world=QUICK_WORLD,
            quiet=True,
        )[0]
        for d in (0.8, 0.9)
    )
    assert worlds.for_guard(far).values.discount == 0.8  # data that cannot be regenerated has no other World
    monkeypatch.setattr(worlds, "_made_here", lambda run: True)
    monkeypatch.setattr(worlds, "_in_cache", lambda *_: "the task's")
    assert worlds.for_guard(far) == "the task's"
    assert worlds.for_guard(usual).values.discount == 0.9
    assert worlds.of_run(far).values.discount == 0.8


def test_one_controller_for_a_run_or_a_callable(small_world, tmp_path):
    """Of a callable it is what `guard` gives; it may be of a World's file, too."""
    seen, state = (np.zeros(k, np.float32) for k in ((3, 18), 18))
    idle = lambda *_: np.zeros((3, 2))  # noqa: E731
    file = world.save(small_world, tmp_path / "w.safetensors")
    other = ringfence.guard(idle, small_world, guard="adapt")
    assert isinstance(other, Controller)
    for given in (file, small_world):
        mine = Controller(idle, world=given, guard="adapt")
        np.testing.assert_array_equal(mine.act(seen, state, cost=1.0), other.act(seen, state, cost=1.0))
        mine.reset(), other.reset()
    with pytest.raises(UserError, match="has no job"):
        _ = mine.job
    for wrong, message in (({}, "give world="), ({"world": file, "planner": "low_temperature"}, "planner='low_temp")):
        with pytest.raises(UserError, match=message):
            Controller(idle, **wrong)


def test_a_controller_may_decide_for_some_of_a_team(small_world, small_store):
    """The others do what is proposed of them, and what is said of a step is said of those for whom it decides."""
    seen, state = small_store.observations[5], small_store.state[5]

    def still(*_):
        return np.zeros((3, 2))

    strict = {"world": small_world, "margin": 50.0}
    team = Controller(still, **strict)
    moved = np.abs(team.act(seen, state)).max(1)
    assert (moved > 1e-3).all()
    pilot = Controller(still, driven=1, **strict)
    np.testing.assert_array_equal(np.abs(pilot.act(seen, state)).max(1) > 1e-3, [False, True, False])
    assert pilot.info["clearance"] == pilot.info["agent_clearance"][1]
    for wrong in (3, [0, -1], 1.0, [], [[0], [1, 2]]):
        with pytest.raises(UserError, match="must be agents, from 0 to 2"):
            Controller(still, driven=wrong, **strict)
