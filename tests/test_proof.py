"""Bounds hold for whatever is sampled, and plans are proved where all that is predicted of them is safe."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ringfence.deploy import zoo
from ringfence.envs import Crossing
from ringfence.errors import UserError
from ringfence.guards import proof as bounds
from ringfence.guards.policy import build
from ringfence.guards.proof import Box, Prover, score_below
from ringfence.guards.wrap import Nothing
from ringfence.loading.resolve import load
from ringfence.nets.layers import MLP
from ringfence.world.barrier import Barrier
from ringfence.world.cause_nets import CauseNet, Distance, worst
from ringfence.world.causes import Cause, Edge
from ringfence.world.quantities import All, Closing, Entry, Length, Over, Product, Sum, Turned

ROWS = 10


@pytest.fixture(scope="module")
def guarded(tmp_path_factory):
    return load(zoo.pretrained("crossing-hasty/bc", tmp_path_factory.mktemp("runs")), guard="shield")[1].one


@pytest.fixture(scope="module")
def present(guarded):
    """States (24, 1, D) of three teams on their way."""
    env = Crossing()
    state = env.reset(jax.random.key(0), 3)
    state = state._replace(
        velocity=0.7 * jax.random.uniform(jax.random.key(1), state.velocity.shape, minval=-1.0, maxval=1.0),
        position=0.6 * state.position,
    )
    return guarded.guard.world.map(env.observe(state).reshape(24, 1, -1), None)


def anywhere(key, center, radius, tries):
    """(tries, ...) points in boxes: half of them anywhere, half in corners, where most is at its extreme."""
    key_inside, key_corner = jax.random.split(key)
    shape = (tries // 2, *center.shape)
    inside = jax.random.uniform(key_inside, shape, minval=-1.0, maxval=1.0)
    corner = jax.random.rademacher(key_corner, shape, jnp.float32)
    return center + radius * jnp.concatenate([inside, corner])


@pytest.mark.parametrize("linear", [False, True])
def test_no_output_of_a_network_lies_beyond_its_bounds(linear):
    """A million inputs of five boxes."""
    key_net, key_center, key_try = jax.random.split(jax.random.key(0), 3)
    net = MLP(key_net, (9, 64, 64, 64, 2), linear=linear)
    if linear:
        net = eqx.tree_at(lambda net: net.linear, net, jax.random.normal(key_net, (1, 9, 2)))
    center = jax.random.normal(key_center, (5, 9))
    radius = jnp.array([0.0, 0.01, 0.1, 0.5, 2.0])[:, None] * jnp.ones(9)
    inputs = bounds.Inputs(center, None, radius)
    low, high = jax.jit(lambda inputs: bounds.output_bounds(net, inputs))(inputs)
    matrix, least, most = jax.jit(lambda inputs: bounds.linear_bounds(net, inputs))(inputs)

    @jax.jit
    def beyond(key):
        x = anywhere(key, center, radius, 20_000)
        y = net(x)
        line = (matrix * x[..., None, :]).sum(-1)
        gaps = [low - y, y - high, line + least - y - 1e-4, y - line - most - 1e-4]
        return jnp.stack([gap.max() for gap in gaps]), y.max(0), y.min(0)

    tried = [beyond(key) for key in jax.random.split(key_try, 10)]
    assert max(float(gap.max()) for gap, _, _ in tried) <= 0.0
    widest = np.max([high for _, high, _ in tried], 0) - np.min([low for _, _, low in tried], 0)
    assert ((high - low)[1:3] < 3.0 * widest[1:3] + 1e-3).all(), "bounds of small boxes are tight"


def test_a_network_within_other_bounds_is_still_bounded():
    """Inputs that follow from fewer numbers, and that may be off by some more."""
    net = MLP(jax.random.key(0), (5, 32, 32, 1))
    map = jax.random.normal(jax.random.key(1), (5, 3))
    center, radius, rest = jnp.ones(5), jnp.array([0.1, 0.2, 0.0]), jnp.array([0.0, 0.0, 0.05, 0.0, 0.3])
    low, high = bounds.output_bounds(net, bounds.Inputs(center, map, radius, rest))
    delta = anywhere(jax.random.key(2), jnp.zeros(3), radius, 20_000)
    off = anywhere(jax.random.key(3), jnp.zeros(5), rest, 20_000)
    y = net((center + delta @ map.T + off)[:, None])[:, 0]
    assert (y >= low).all() and (y <= high).all()


def test_no_state_and_no_score_lies_beyond_what_is_proved(guarded, present):
    """From a million rows that begin in the box, by the actions of the plan: others seen now, and some not for two
    steps, after any acceleration."""
    world = guarded.guard.world
    prover = Prover(world, 0.02, 1.0, ROWS)
    plan = jax.random.uniform(jax.random.key(5), (24, 3, 1, 2), minval=-1.0, maxval=1.0)
    unseen = jnp.arange(24)[:, None] % 3

    @jax.jit
    def known(present):
        actions = prover.braked(present, plan)
        box = prover.reached(present, actions, unseen)
        return actions, box, prover.lower_bounds(present, actions, unseen), prover._possible(present, unseen)

    actions, box, low, spread = known(present)

    @jax.jit
    def beyond(key):
        def step(x, given):
            action, box, low = given
            after, _ = world.dynamics.step(x, jnp.broadcast_to(action, (*x.shape[:-1], 2)))
            score = world.barrier.apart(x, after)[..., 0]
            out = jnp.abs(after - box.center) - box.radius
            return after, (out.max(), (low - score).max(), score.min(0) - low)

        by_row = [jnp.moveaxis(x, 1, 0) for x in (actions, *box, low)]
        given = by_row[0], Box(by_row[1], by_row[2]), by_row[3]
        return jax.lax.scan(step, anywhere(key, present, spread, 420), given)[1]

    found = [beyond(key) for key in jax.random.split(jax.random.key(6), 10)]
    assert max(float(out.max()) for out, _, _ in found) <= 0.0
    assert max(float(below.max()) for _, below, _ in found) <= 0.0
    assert np.median(np.min([gap for _, _, gap in found], 0)) < 0.3, "in margins: bounds are near what was met"
    assert (spread[unseen[:, 0] == 2].max() > 0.03).all() and spread[unseen[:, 0] == 0].max() == pytest.approx(0.02)


def test_the_way_out_that_scores_best_is_taken(guarded, present):
    """It begins with the action that was asked for, and is no worse than braking."""
    world = guarded.guard.world
    prover = Prover(world, 0.02, 0.0, ROWS)
    plan = jax.random.uniform(jax.random.key(7), (24, 3, 1, 2), minval=-1.0, maxval=1.0)

    @jax.jit
    def known(present):
        found, braked = prover.continued(present, plan), prover.braked(present, plan)
        return found, [prover._predicted(present, x[:, None])[:, 0] for x in (found, braked)]

    found, (best, braked) = known(present)
    np.testing.assert_allclose(found[:, 0], plan[:, 0], atol=1e-6)
    assert (best >= braked - 1e-4).all() and (best > braked + 0.1).any()


def test_braking_ends_in_standing(guarded, present):
    world = guarded.guard.world
    prover = Prover(world, 0.02, 0.0, 16)
    actions = prover.braked(present, jnp.zeros((24, 3, 1, 2)))
    x = present
    for k in range(16):
        x, _ = world.dynamics.step(x, actions[:, k])
    assert np.abs(x[..., :2]).max() < 0.05 and np.abs(actions).max() <= 1.0
    np.testing.assert_array_equal(actions[:, :3], 0.0)


def test_causes_are_bounded_too():
    """Distances with one edge and several, of every quantity and of rules, and networks of several numbers: some of
    them together, and each."""
    offset = Entry((0, 2), "other.dx"), Entry((1, 3), "other.dy")
    own = Entry((4,), "own.x"), Entry((5,), "own.y")
    against = tuple(Sum((one,), (-1.0,)) for one in own)
    far, fast = Length(offset), Length(own)
    turned = [Turned(offset, looks, what) for looks in (own, own[:1]) for what in ("ahead", "aside", "angle")]
    both = [
        (far, Closing(offset, own)),
        (far, fast),
        turned[:2],
        turned[3:5],
        (far, own[0]),
        (far, Closing(offset, against)),
    ]
    places = (*own, *(Sum((mine, theirs), (1.0, 1.0)) for mine, theirs in zip(own, offset)))
    several = [*both, own, (own[0], Length(offset)), places]
    numbers = [
        far,
        Over(far, "things", 2, 2),
        Over(far, "things"),
        Over(Product((own[0], own[1])), "team"),
        Over(own[0], "team", 1),
        *turned,
        *(Sum(pair, (1.0, w), -0.8) for pair in both for w in (-0.7, 0.7)),
        *(All(tuple(Sum((one,), (w,), -0.5) for one, w in zip(pair, (1.0, -0.6)))) for pair in (*both, places)),
    ]
    edge = Edge((0.0,), (3.0,), bounds=(0.5,), inside=True)
    walls = Edge((-2.0,), (2.0,), bounds=(-1.0, 1.0), inside=True)
    nets = (
        *(Distance(jnp.array([0.4]), jnp.array(1.2), jnp.array(0.3), Cause((one,)), edge) for one in numbers),
        Distance(jnp.array([-1.0, 1.0]), jnp.array(1.0), jnp.array(0.0), Cause(own[:1]), walls),
        *(
            CauseNet(MLP(jax.random.key(4), (k, 16, 16, 1)), jnp.zeros(k), jnp.ones(k), jnp.array(0.1), cause, edge)
            for cause in (Cause(tuple(reads)) for reads in several)
            for k in (cause.width,)
        ),
    )
    center = jax.random.normal(jax.random.key(1), (30, 2, 6))
    radius = 0.3 * jax.random.uniform(jax.random.key(2), center.shape)
    inside = anywhere(jax.random.key(3), center, radius, 6_000)
    for some in (nets[:3], *((net,) for net in nets)):
        barrier = Barrier({}, {}, *(jnp.ones(6),) * 4, jnp.ones(()), shape=None, causes=some)
        low = score_below(barrier, Box(center, radius))
        score = worst(some, inside)
        assert (score.min(0) >= low).all()
        assert np.median(score.min(0) - low) < 0.6


def test_a_step_says_whose_plan_is_proved(guarded, present):
    """Of agents who see others far away it is, of those who see one at their side it is not."""
    world = guarded.guard.world
    options = {
        "proof": 0.02,
        "proof_rows": 4,
        "correction_steps": 1,
        "correction_restarts": 0,
        "horizon": 1,
    }
    policy = build(Nothing(), world, None, "shield", "learned", terminal_value=False, **options)
    decided = eqx.filter_jit(policy.decided)
    prover = Prover(world, 0.02, 0.0, 4)
    far, near = jnp.array([2.5, 0.0, 0.0, 0.0, 1.0]), jnp.array([0.15, 0.0, 0.0, 0.0, 1.0])  # dx, dy, dvx, dvy, seen
    safe, danger = (present.at[..., 4:].set(jnp.tile(other, 6)) for other in (far, near))
    wanted = jnp.full((24, 1, 1, 1, 2), 0.3)
    carry, step = decided(policy.initial_state(24), safe, wanted, jax.random.key(0))
    assert step.info["proved"].all() and step.info["agent_proved"].all()
    low = prover.lower_bounds(safe, prover.continued(safe, step.action[:, None]), None).min(1)
    assert (low >= 0).all()
    _, step = decided(carry, danger, wanted, jax.random.key(1))
    assert not step.info["proved"].any() and not step.info["agent_proved"].any()


def test_what_cannot_be_proved_is_refused(guarded, small_world):
    with pytest.raises(UserError, match="proof is of Worlds of homogeneous agents"):
        build(Nothing(), small_world, None, "shield", "learned", proof=0.02)
    with pytest.raises(UserError, match="proof=-1"):
        build(Nothing(), guarded.guard.world, None, "shield", "learned", proof=-1.0)
