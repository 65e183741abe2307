"""One contract for every algorithm, and what is special about the flagship."""

import dataclasses
import json
import shutil

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ringfence import algos
from ringfence.algos import icbf
from ringfence.datasets import registry
from ringfence.deploy.controller import Controller
from ringfence.errors import CheckpointError, UserError
from ringfence.evaluation import protocol
from ringfence.evaluation.evaluate import evaluate
from ringfence.loading import resolve
from ringfence.loading.resolve import load
from ringfence.loading.spec import PolicySpec
from ringfence.logs.store import EpisodeStore
from ringfence.logs.windows import draw
from ringfence.proposals import guidance
from ringfence.proposals.guidance import FAR, ROWS, Way, climb, guided_by
from ringfence.proposals.options import WIDE
from ringfence.training import loop
from ringfence.training.job import make_job
from ringfence.training.runs import Run
from ringfence.types import PolicyStep, act_with
from ringfence.utils.config import build_config
from tests.quick import QUICK_WORLD

TINY = {  # all that learn; the naive driver of the proving ground does not
    "icbf": dict(num_updates=12, batch=16, width=16, depth=1, barrier_batch=8, barrier_width=8,
                 inverse_width=16, horizon=4, diffusion_steps=20, barrier_start=0.0, barrier_full=0.2),
    "madiff": dict(num_updates=12, batch=16, width=16, depth=1, inverse_width=16, horizon=4, diffusion_steps=20),
    "flow": dict(num_updates=12, batch=16, width=16, depth=2, drivers=4, condition="raw"),
    "mpc": dict(num_updates=12),
    "bc": dict(num_updates=12, batch=32, width=16, depth=1),
    "bc-safe": dict(num_updates=12, batch=32, width=16, depth=1),
    "bc-best": dict(num_updates=12, batch=32, width=16, depth=1),
    "bc-return": dict(num_updates=12, batch=32, width=16, depth=1, condition="advantage"),
    "ma-td3bc": dict(num_updates=12, batch=32, width=16, centralised_critic=True, delay=2, target_noise=0.2),
    "ma-td3bc-lag": dict(num_updates=12, batch=32, width=16),
    "omar": dict(num_updates=12, batch=32, width=16),
    "ma-cql": dict(num_updates=12, batch=32, width=16, cql_actions="policy"),
    "fisor": dict(num_updates=12, batch=32, width=16, candidates=2),
}  # fmt: skip
QUICK = {"episodes": 4, "sampling_steps": 2}
ACT = jax.jit(act_with)  # one program; step by step, every operation of a policy is one to compile


def job_of(name):
    """What training of an algorithm is told: tiny settings, and a World that is fitted quickly where it reads one."""
    algorithm = algos.get(name)
    reads_world = algorithm.world_settings(build_config(algorithm.Config, TINY[name], name)) is not None
    return {"changes": TINY[name], "quiet": True} | ({"world": QUICK_WORLD} if reads_world else {})


@pytest.fixture(scope="session")
def trained(small_store, tmp_path_factory):
    """One tiny finished run of every algorithm."""
    out = tmp_path_factory.mktemp("runs")
    return {name: loop.train(name, small_store, out=out, chunk=6, **job_of(name))[0] for name in TINY}


@pytest.mark.parametrize("name", TINY)
def test_contract(name, trained):
    """Finite metrics, the whole of training done, and a policy that acts within bounds and the same after loading."""
    run = trained[name]
    rows = run.metrics
    assert [r["step"] for r in rows] == [6, 12]
    assert all(np.isfinite(v) for r in rows for v in r.values())
    assert run.checkpoints()[-1][0] == 12
    env = registry.get("simple_spread-random").env
    state = env.reset(jax.random.key(0), 5)
    actions = []
    for _ in range(2):
        _, policy = load(run, sampling_steps=2)
        seen = (env.observe(state), env.global_state(state))
        _, out = ACT(policy, policy.initial_state(5), *seen, jax.random.key(1))
        actions.append(np.asarray(out.action))
    assert actions[0].shape == (5, 3, 2) and np.abs(actions[0]).max() <= 1.0
    np.testing.assert_array_equal(*actions)


@pytest.mark.parametrize("name", TINY)
def test_policies_act_within_any_bounds(name, trained):
    """What was learned between −1 and 1 is played between the bounds of the task."""
    _, policy = load(trained[name])
    env, acted = registry.get("simple_spread-random").env, []
    state = env.reset(jax.random.key(0), 5)
    seen, whole = env.observe(state), env.global_state(state)
    for low, high in ((-1.0, 1.0), (2.0, 8.0)):
        spec = dataclasses.replace(policy.spec, action_low=low, action_high=high)
        told = dataclasses.replace(policy, spec=spec)
        act = jax.jit(lambda key, told=told: told.act(told.initial_state(5), seen, whole, key)[1].action)
        acted.append(np.asarray(act(jax.random.key(1))))
    np.testing.assert_allclose(acted[1], 5 + 3 * acted[0], atol=1e-4)


@pytest.mark.parametrize("guard", ["shield", "full"])
@pytest.mark.parametrize("name", TINY)
def test_every_guard_takes_every_algorithm(name, guard, trained, small_world):
    """Whether it asks for one proposal or for several. Shapes alone: nothing is compiled."""
    _, policy = load(trained[name], guard=guard, horizon=3, world=small_world, anyway=True)
    env = registry.get("simple_spread-random").env
    state = jax.eval_shape(lambda key: env.reset(key, 5), jax.random.key(0))

    def acted(state, key):
        return policy.act(policy.initial_state(5), env.observe(state), env.global_state(state), key)

    _, out = jax.eval_shape(acted, state, jax.random.key(1))
    assert out.action.shape == (5, 3, 2)


def test_killed_and_resumed_equals_uninterrupted(small_store, trained, tmp_path):
    """To the last bit, with a chunk length that does not divide the checkpoint's step."""

    def stop(step, _):
        if step >= 8:
            raise KeyboardInterrupt

    how = dict(out=tmp_path, **job_of("icbf"))
    with pytest.raises(KeyboardInterrupt):
        loop.train("icbf", small_store, chunk=4, checkpoint_every=4, on_chunk=stop, **how)
    run = loop.train("icbf", small_store, chunk=3, **how)[0]
    from safetensors.numpy import load_file

    a = load_file(run.checkpoints()[-1][1])
    b = load_file(trained["icbf"].checkpoints()[-1][1])
    assert a.keys() == b.keys()
    for k in a:
        np.testing.assert_array_equal(a[k], b[k], err_msg=k)
    steps = [r["step"] for r in run.metrics]
    assert steps == sorted(set(steps)) and steps[-1] == 12


def test_no_weight_is_madiff(small_store, tmp_path):
    """λ = 0, the default: the planner's networks are MADIFF's, but for how two programs round."""
    zero = loop.train("icbf", small_store, out=tmp_path, **job_of("icbf"))[0]
    plain = loop.train("madiff", small_store, out=tmp_path, **job_of("madiff"))[0]
    from safetensors.numpy import load_file

    a, b = (load_file(r.checkpoints()[-1][1]) for r in (zero, plain))
    for k in b:
        if k.split("/")[0] in ("params", "ema", "frozen"):
            np.testing.assert_allclose(a[k], b[k], rtol=1e-5, atol=1e-7, err_msg=k)
    assert a.keys() == b.keys()


@pytest.mark.parametrize(("name", "remedy"), [("bc", "leave it out"), ("bc-return", "set it when it is trained")])
def test_a_return_is_not_asked_for_in_vain(small_store, tmp_path, name, remedy):
    run = loop.train(name, small_store, out=tmp_path, **job_of(name))[0]
    with pytest.raises(UserError, match=f"target_return=2.0 asks for a return, and {name} .*; {remedy}"):
        load(run, target_return=2.0)


def test_seeds_in_one_program_match_seeds_apart(small_store, tmp_path):
    changes = TINY["bc"]
    apart = loop.train("bc", small_store, seeds=(0, 1), out=tmp_path / "a", changes=changes, quiet=True)
    together = loop.train(
        "bc",
        small_store,
        seeds=(0, 1),
        out=tmp_path / "b",
        changes=changes,
        quiet=True,
        vmap_seeds=True,
        tensorboard=True,
    )
    assert all(list((run.path / "tensorboard").glob("events*")) for run in together)
    more = dict(changes=changes, quiet=True, vmap_seeds=True)
    both = loop.train("bc", small_store, seeds=(0, 2), out=tmp_path / "b", **more)  # a seed beside those there
    assert [run.metrics[-1]["step"] for run in both] == [12, 12]
    for x, y in zip(apart, together):
        assert x.metrics[-1]["loss/cloning"] == pytest.approx(y.metrics[-1]["loss/cloning"], rel=1e-4)


@pytest.mark.parametrize("gradient", ["ddim:2", "chain:2"])
def test_gradient_depths(small_store, small_world, gradient):
    """The barrier's share of the loss reaches the denoiser through the sampler, too."""
    task = registry.from_store(small_store)
    job = make_job(
        "icbf", task, None, {**TINY["icbf"], "gradient": gradient, "barrier_weight": 1.0}, small_store, QUICK_WORLD
    )
    data = loop.windows_of(job, small_store, small_world)
    key = jax.random.key(0)
    state = job.algorithm.init(key, job.spec, job.config, data, job.feature_map, job.hazard, small_world)
    loss = icbf.make_loss(job.config, job.feature_map)
    batch = draw(data.arrays, jax.random.key(1), 16, 4, job.config.window_history)

    @jax.jit
    def pull(denoiser):
        params = {**state["params"], "denoiser": denoiser}
        return loss(params, state["frozen"] | state["world"], batch, 12, jax.random.key(2), (0.0, 1.0))[0]

    grads = jax.grad(pull)(state["params"]["denoiser"])
    size = sum(float(jnp.abs(g).sum()) for g in jax.tree.leaves(grads))
    assert np.isfinite(size) and size > 0


@pytest.mark.parametrize(
    "options",
    [
        dict(),
        dict(num_samples=3, guard="select", barrier="both"),
        dict(replan=2, sampler="dpm++"),
        dict(num_samples=2, select=True, value_guidance=0.5, anyway=True, sampler="ddpm", correction_steps=2),
    ],
)
def test_planner_options(trained, options):
    run = trained["icbf"]
    result = evaluate(run, **QUICK, num_recorded=2, **options)
    assert result["episodes"] == 4 and np.isfinite(result["return_mean"])
    assert len(run.results) >= 1


def test_several_plans_are_drawn_ever_farther_apart(trained, small_store):
    """The first of several has the noise of `temperature`, as one alone, and the last that times `spread`."""
    seen, state = jnp.asarray(small_store.observations[:2]), jnp.asarray(small_store.state[:2])

    def drawn(count: int, **options) -> np.ndarray:
        policy = load(trained["icbf"], sampling_steps=1, barrier_guidance=0.0, **options)[1]
        past, present = policy._context(policy.initial_state(2), seen, state)
        driver = jnp.zeros(2 * count, jnp.int32) if policy.drivers else None
        return np.asarray(eqx.filter_jit(policy.plans)(past, present, jax.random.key(0), count, driver))

    wide = drawn(3, temperature=0.5, spread=3.0)
    for k, temperature in enumerate((0.5, 1.0, 1.5)):
        np.testing.assert_allclose(wide[:, k], drawn(3, temperature=temperature, spread=1.0)[:, k], atol=1e-6)
    np.testing.assert_array_equal(drawn(1, spread=3.0), drawn(1, spread=1.0))
    assert load(trained["icbf"])[1].options.spread == WIDE


def test_values_steer_what_is_drawn(trained, small_store, small_world, monkeypatch):
    """Actions that climb are worth more by what the World foresees, and plans that are steered are others."""
    policy = load(trained["icbf"], world=small_world, value_guidance=1.0, anyway=True)[1]
    assert guided_by(policy) == {"guided_by_values": 1.0, "guided_by_danger": 10.0}
    seen, state = jnp.asarray(small_store.observations[:8]), jnp.asarray(small_store.state[:8])
    judged = policy.guide.world.map(seen, state)
    actions = jnp.zeros((8, ROWS, 3, 2))
    way = Way(lambda x: x, lambda _, row: row, actions[:, 0], False)
    worth = lambda actions: policy.guide.worth(judged, way, actions, 0.0 * actions)[0].sum()  # noqa: E731
    with monkeypatch.context() as m:
        m.setattr(guidance, "FAR", 0.01)
        assert worth(policy.guide.moved(judged, way, actions, 3)) > worth(actions) + 0.01
    first = [policy.act(policy.initial_state(8), seen, state, jax.random.key(0))[1].action]
    unsteered = dataclasses.replace(policy, guide=None)
    first.append(unsteered.act(unsteered.initial_state(8), seen, state, jax.random.key(0))[1].action)
    assert jnp.isfinite(first[0]).all() and jnp.abs(first[0] - first[1]).max() > 0.05
    with pytest.raises(UserError, match="worse than by their mean, and these options climb them"):
        load(trained["icbf"], value_guidance=1.0)
    alone = load(trained["icbf"])[1]
    assert guided_by(alone) == {"guided_by_values": 0.0, "guided_by_danger": 10.0}, "danger alone, by itself"
    guarded = load(trained["icbf"], guard="shield", anyway=True)[1]
    assert guided_by(guarded.proposal)["guided_by_danger"] == 0.0, "of danger alone the guard takes care"
    monkeypatch.setattr("ringfence.loading.resolve.knows_ahead", lambda world: True)
    for guard, values in (("shield", 1.0), ("adapt", 0.0), ("full", 0.0)):
        assert guided_by(load(trained["icbf"], guard=guard, anyway=True)[1].proposal)["guided_by_values"] == values


def test_what_is_climbed_moves_actions_by_what_is_asked_and_stays_in_bounds():
    actions = jnp.array([[0.0, 0.9], [0.0, 0.0]]).reshape(2, 1, 1, 2)
    up = jnp.broadcast_to(jnp.array([4.0, 3.0]), actions.shape)
    worth = jnp.array([-1.0, -2.5])
    np.testing.assert_allclose(climb(actions, worth, up, FAR)[:, 0, 0], [[0.4, 0.1], [0.4, 0.3]], atol=1e-6)
    np.testing.assert_allclose((climb(actions, worth, up, None) * up)[1].sum(), 2.5, atol=1e-5)
    np.testing.assert_array_equal(climb(actions, worth, 0.0 * up, FAR), 0.0 * up)


def test_a_controller_acts_like_the_policy(trained, small_store):
    how = dict(planner="published", guard="select", sampling_steps=2, num_samples=2, correction_steps=1, anyway=True)
    pilot = Controller(trained["icbf"], **how)
    assert pilot.policy.proposal.options.temperature == 0.5 and pilot.policy.guard.options.num_samples == 2
    seen, state = small_store.observations[0], small_store.state[0]
    first = pilot.act(seen, state)
    assert first.shape == (3, 2) and (np.abs(first) <= 1).all() and pilot.info["ood"].dtype == bool
    again = Controller(trained["icbf"], **how)
    np.testing.assert_array_equal(again.act(seen, state), first)
    again.reset()
    assert not np.array_equal(again.act(seen, state), first)  # a new draw of plans
    with pytest.raises(UserError, match="did you mean 'shield'"):
        Controller(trained["icbf"], guard="shild")


@pytest.mark.parametrize(
    ("seen", "state", "said"),
    [
        (np.zeros((2, 18)), np.zeros(18), r"observations has shape \(2, 18\), this run takes \(3, 18\)"),
        (np.zeros((4, 18)), np.zeros(18), r"observations has shape \(4, 18\)"),
        (np.zeros((3, 17)), np.zeros(18), r"observations has shape \(3, 17\)"),
        (np.zeros((1, 3, 18)), np.zeros(18), r"observations has shape \(1, 3, 18\)"),
        (np.zeros((3, 18)), np.zeros(19), r"state has shape \(19,\), this run takes \(18\)"),
        (np.zeros((3, 18)), np.full(18, np.nan), r"state\[0\] is nan"),
        (np.full((3, 18), np.inf), np.zeros(18), r"observations\[0, 0\] is inf"),
        ([[0.0], [0.0, 1.0]], np.zeros(18), "observations is no array of numbers"),
        (
            np.zeros((3, 18)),
            None,
            r"act\(\) got no state, .* view 'pruned' reads it; pass the global state \(18 entries\)",
        ),
    ],
)
def test_a_controller_refuses_what_is_no_observation(trained, seen, state, said):
    pilot = Controller(trained["madiff"], sampling_steps=2)
    with pytest.raises(UserError, match=said):
        pilot.act(seen, state)


def test_names_of_variants_follow_values(trained):
    """Neither the order nor the spelling of options makes another variant; those that results hold keep their names."""
    run = Run(trained["icbf"].path)
    for options, name in (
        ({"guard": "select", "num_samples": 3}, "default+select-learned+num_samples3"),
        ({"planner": "low_temperature", "sampling_steps": 2}, "default+low_temperature+sampling_steps2"),
        ({"margin": 0, "horizon": "2", "guard": "shield"}, "default+shield-learned+horizon2+margin0.0"),
        ({"temperature": "1e1"}, "default+temperature10.0"),
        ({"guard": "adapt", "barrier": "analytic", "adapt": 0.2}, "default+adapt-analytic+adapt0.2"),
    ):
        assert resolve.resolve(PolicySpec.of(run, **options)).variant("test") == name
    assert evaluate(run, episodes=1, sampling_steps="2")["variant"] == "default+sampling_steps2"


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"num_updates": -3}, "num_updates=-3 of bc must be at least 1"),
        ({"batch": 0}, "batch=0 of bc must be at least 1"),
        ({"lr": -1.0}, "lr=-1.0 of bc must be positive"),
        ({"ema": 3.0}, "ema=3.0 of bc must be between 0 and 1"),
        ({"lr": float("nan")}, "lr=nan of bc must be finite"),
    ],
)
def test_settings_that_mean_nothing_are_refused(small_store, tmp_path, changes, said):
    with pytest.raises(UserError, match=said):
        loop.train("bc", small_store, out=tmp_path, changes=changes)
    assert not list(tmp_path.iterdir())


def test_no_seed_and_no_store_are_refused(small_store, tmp_path):
    for seeds in ((), (-1,)):
        with pytest.raises(UserError, match="must be one or more whole numbers from 0"):
            loop.train("bc", small_store, out=tmp_path, seeds=seeds)
    with pytest.raises(UserError, match="data of type str; pass an EpisodeStore"):
        loop.train("bc", "simple_spread-random", out=tmp_path)


def test_who_saw_one_agent_plans_alone(small_store, tmp_path):
    """What another agent sees changes one's own action where one plan is drawn for all, and not where each plans."""
    moved = {}
    for observe in ("all", "single"):
        changes = {**TINY["madiff"], "view": "decentralized", "num_updates": 30, "observe": observe}
        asked = {"changes": changes, "world": {**QUICK_WORLD, "barrier": False}}
        run = loop.train("madiff", small_store, out=tmp_path / observe, **job_of("madiff") | asked)[0]
        _, policy = load(run)
        seen, state = small_store.observations[:4], small_store.state[:4]
        other = seen.copy()
        other[:, 1] += 0.5
        steps = (ACT(policy, policy.initial_state(4), o, state, jax.random.key(0))[1] for o in (seen, other))
        a, b = (np.asarray(step.action) for step in steps)
        moved[observe] = np.abs(a - b)[:, 0].max()
    assert moved["all"] > 1e-5 and moved["single"] < 1e-7
    with pytest.raises(UserError, match="execution='centralized' needs a model"):
        load(run, execution="centralized")


@pytest.mark.parametrize("view, execution", [("centralized", "centralized"), ("decentralized", "decentralized")])
def test_views(small_store, tmp_path, view, execution):
    changes = {**TINY["madiff"], "view": view, "num_updates": 2, "observe": "mixed"}
    run = loop.train(
        "madiff",
        small_store,
        out=tmp_path,
        **job_of("madiff") | {"changes": changes, "world": {**QUICK_WORLD, "barrier": False}},
    )[0]
    result = evaluate(run, **QUICK, execution=execution)
    assert np.isfinite(result["return_mean"])


def test_paired_resets(trained):
    """All methods start from the same states, and the first n episodes do not depend on how many are played."""
    task = registry.get("simple_spread-random")
    _, bc = load(trained["bc"])
    _, other = load(trained["bc-safe"])
    a = protocol.rollout(bc, task.env, 60)["states"]
    b = protocol.rollout(other, task.env, 3)["states"]
    np.testing.assert_array_equal(a[:3, 0], b[:, 0])
    np.testing.assert_array_equal(a[:3], protocol.rollout(bc, task.env, 3)["states"])
    validation = protocol.rollout(bc, task.env, 3, "validation")["states"]
    assert not np.array_equal(a[:3, 0], validation[:, 0])


def test_bad_input_is_refused(small_store, trained, tmp_path):
    run = trained["icbf"]
    with pytest.raises(UserError, match="did you mean 'icbf'"):
        loop.train("icfb", small_store, out=tmp_path)
    with pytest.raises(UserError, match="did you mean 'barrier_weight'"):
        loop.train("icbf", small_store, out=tmp_path, changes={"barier_weight": 1})
    with pytest.raises(UserError, match="preset"):
        loop.train("icbf", small_store, out=tmp_path, preset="spilt")
    with pytest.raises(UserError, match=r"retention m=1.0"):
        loop.train("icbf", small_store, out=tmp_path, changes={**TINY["icbf"], "retention": 1.0})
    with pytest.raises(UserError, match="another run"):
        changed = job_of("icbf") | {"changes": {**TINY["icbf"], "lr": 0.1}}
        loop.train("icbf", small_store, out=run.path.parents[2], **changed)
    more = dataclasses.replace(small_store, rewards=small_store.rewards + 1)  # under the same name
    with pytest.raises(UserError, match="another run .its data's content differs"):
        loop.train("icbf", more, out=run.path.parents[2], **job_of("icbf"))
    with pytest.raises(UserError, match="width=100 must be a multiple of 16"):
        loop.train("madiff", small_store, out=tmp_path, changes={**TINY["madiff"], "width": 100, "net": "attention"})
    with pytest.raises(UserError, match="distinguish_agents is of the net attention; leave it out with net='residual'"):
        loop.train("madiff", small_store, out=tmp_path, changes={**TINY["madiff"], "distinguish_agents": True})
    blank = {"card": small_store.card.updated(task="mine", hazard={"kind": "CostColumn"})}
    blank = dataclasses.replace(small_store, costs=0 * small_store.costs, **blank)
    for name in ("icbf", "fisor", "bc-safe", "ma-td3bc-lag"):
        with pytest.raises(UserError, match=f"{name} has no danger to learn"):
            loop.train(name, blank, out=tmp_path, changes=TINY[name])
    with pytest.raises(UserError, match="planner"):
        evaluate(run, planner="gaurded")
    with pytest.raises(UserError, match="barrier is read by nothing without a guard"):
        evaluate(run, barrier="analytic")
    with pytest.raises(UserError, match="1 to 20 steps"):
        evaluate(run, sampling_steps=21)
    with pytest.raises(UserError, match="trained with observe"):
        evaluate(run, execution="decentralized")
    with pytest.raises(UserError, match="carry='all'"):
        evaluate(run, reconcile=False)
    with pytest.raises(UserError, match="did you mean 'paper'"):
        loop.train("icbf", small_store, out=tmp_path, changes={"routing": "papr"})
    with pytest.raises(UserError, match="horizon=7 rows are judged, but plans hold 3 steps"):
        evaluate(run, guard="shield", horizon=7)
    assert not any(tmp_path.rglob("ckpt"))


def test_broken_checkpoints_are_refused(trained, small_store, tmp_path, caplog):
    run = Run(tmp_path / "copy")
    shutil.copytree(trained["bc"].path, run.path)
    file = run.checkpoints()[-1][1]
    whole = file.read_bytes()
    from safetensors.numpy import load_file, save_file

    before = run.checkpoints()[-2][0]
    flipped = bytearray(whole)
    flipped[-5] ^= 1  # of a weight
    stepped = {**load_file(file), "step": np.array(-7, np.int32)}
    for wrong in (whole[: len(whole) // 2], bytes(flipped), stepped):
        save_file(wrong, file) if isinstance(wrong, dict) else file.write_bytes(wrong)
        assert resolve.resolve(PolicySpec.of(run)).step == before
        assert "the one before is used" in caplog.text
        caplog.clear()
        with pytest.raises(CheckpointError, match="truncated or damaged.*train the run again"):
            resolve.resolve(PolicySpec.of(run, checkpoint=12))
    file.write_bytes(whole)
    again = loop.train("bc", small_store, folder=lambda seed: run.path, chunk=6, **job_of("bc"))[0]
    assert again.checkpoints()[-1] == (12, file) and file.read_bytes() == whole
    file.write_bytes(whole[:100])  # a finished run whose end was lost is finished again, to the same bits
    loop.train("bc", small_store, folder=lambda seed: run.path, chunk=6, **job_of("bc"))
    assert file.read_bytes() == whole
    arrays = load_file(file)
    name = next(k for k in arrays if k.startswith("ema"))
    save_file({k: v for k, v in arrays.items() if k != name}, file)
    with pytest.raises(CheckpointError, match="lacks the array"):
        load(run)
    save_file({**arrays, name: np.zeros((1, 2, 3), np.float32)}, file)
    with pytest.raises(CheckpointError, match="another task or config"):
        load(run)
    with pytest.raises(UserError, match="no run folder"):
        load(Run(tmp_path / "nothing"))


def test_full_disk_keeps_the_last_checkpoint(trained, tmp_path, monkeypatch):
    from ringfence.utils import pytrees

    run = Run(tmp_path / "copy")
    shutil.copytree(trained["bc"].path, run.path)
    before = [s for s, _ in run.checkpoints()]

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pytrees, "save_file", full)
    with pytest.raises(UserError, match="free some space"):
        run.save_checkpoint(99, {"x": jnp.zeros(2)})
    assert [s for s, _ in run.checkpoints()] == before
    assert not list((run.path / "ckpt").glob("*.part"))


def test_a_program_that_does_not_count_its_updates_is_not_believed(small_store, tmp_path, monkeypatch):
    """As jax 0.5.3 does with one that it kept, where a user has chosen a folder for them."""
    real = loop.make_program

    def forgetful(job):
        program = real(job)

        def advance(state, *given):
            after, metrics = program.advance(jax.tree.map(jnp.copy, state), *given)
            return {**after, "step": state["step"]}, metrics

        return program._replace(advance=advance)

    monkeypatch.setattr(loop, "make_program", forgetful)
    with pytest.raises(UserError, match="After 1 updates the state counts 0: .*unset JAX_COMPILATION_CACHE_DIR"):
        loop.train("bc", small_store, out=tmp_path, changes=TINY["bc"], quiet=True, chunk=1)


def test_own_data_without_a_simulator(own_store, tmp_path):
    """Anybody's logs: a store with named features, a hazard, a policy that acts; nothing of Simple Spread is known."""
    store = own_store
    how = job_of("icbf") | {"changes": {**TINY["icbf"], "num_updates": 2}}
    run = loop.train("icbf", store, out=tmp_path, **how)[0]
    _, policy = load(run, guard="select", num_samples=2, sampling_steps=2)
    seen = jnp.asarray(store.observations[:4])
    _, out = ACT(policy, policy.initial_state(4), seen, None, jax.random.key(0))
    assert out.action.shape == (4, 3, 2)
    with pytest.raises(UserError, match="only as data"):
        evaluate(run)
    pilot = Controller(run, sampling_steps=2)
    assert pilot.act(store.observations[0]).shape == (3, 2)
    wide = store.observations.shape[2]
    for seen, state, said in (
        (store.observations[0][:, :-1], None, rf"shape \(3, {wide - 1}\), this run takes \(3, {wide}\)"),
        (store.observations[0], np.zeros(4), "has no global state, but act"),
    ):
        with pytest.raises(UserError, match=said):
            pilot.act(seen, state)
    told = json.loads((run.path / "config.json").read_text())
    least, most = store.returns.min(), store.returns.max()  # by which returns are normalised
    np.testing.assert_allclose(resolve.load_job(run).task.normalised_return(np.array([least, most])), [0, 1], atol=1e-6)
    del told["widths"], told["team"], told["returns"]  # as a stranger may write it
    del told["data"]["observation_names"]
    (run.path / "config.json").write_text(json.dumps(told))
    pilot = Controller(run, sampling_steps=2)
    assert pilot.act(store.observations[0]).shape == (3, 2)
    with pytest.raises(UserError, match="This run reads entry .* of observations with 3"):
        pilot.act(store.observations[0][:, :3])


def test_an_unfinished_run_is_said_to_be_one(small_store, trained, tmp_path, caplog):
    def stop(step, _):
        if step >= 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        loop.train("bc", small_store, out=tmp_path, changes=TINY["bc"], quiet=True, chunk=5, on_chunk=stop)
    run = Run(next(tmp_path.rglob("config.json")).parent)
    assert evaluate(run, episodes=2)["step"] == 5
    assert "is at step 5 of 12; its training is unfinished" in caplog.text
    caplog.clear()
    assert evaluate(str(trained["bc"].path), episodes=2)["step"] == 12
    assert not caplog.text
    with pytest.raises(CheckpointError, match="no checkpoint of step 7; take one of: 5"):
        evaluate(run, episodes=2, checkpoint=7)


class Lost(eqx.Module):
    """Its actions are no numbers."""

    def initial_state(self, batch):
        return {}

    def act(self, carry, observations, state, key):
        return carry, PolicyStep(jnp.full((*observations.shape[:2], 2), jnp.nan), {})


def test_actions_that_are_no_numbers_do_not_pass_for_safe():
    with pytest.raises(UserError, match="Step 0 of episode 0 has a reward or state that is not finite"):
        protocol.evaluate_policy(Lost(), registry.get("simple_spread-random"), episodes=2)


def test_results_that_cannot_be_read_are_refused_before_an_episode_is_played(trained, tmp_path, monkeypatch):
    run = Run(tmp_path / "copy")
    shutil.copytree(trained["bc"].path, run.path)
    (run.path / "results.json").write_text("{")
    monkeypatch.setattr(protocol, "evaluate_policy", lambda *_: pytest.fail("it was played"))
    with pytest.raises(UserError, match="holds a damaged results.json; delete that file"):
        evaluate(run, episodes=2)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"seeds": 5}, "seeds=5 must be several whole numbers; give e.g. range"),
        ({"seeds": (0, 0)}, "each of them once"),
        ({"seeds": (2**31,)}, "whole numbers from 0 to 2³¹ − 1"),
        ({"seeds": ()}, "one or more whole numbers"),
        ({"chunk": -1}, "chunk=-1 must be a whole number from 1"),
        ({"checkpoint_every": 0}, "checkpoint_every=0 must be a whole number from 1"),
        ({"changes": {"num_updates": None}}, "num_updates=None of bc must be a whole number"),
        ({"changes": {"batch": 32.5}}, "batch=32.5 of bc must be a whole number"),
        ({"changes": {"lr": True}}, "lr=True of bc must be a number"),
        ({"changes": {"cost_limit": "abc"}}, "cannot be read as a number or none"),
    ],
)
def test_what_training_is_told_wrongly_is_refused_before_a_folder_is_made(small_store, tmp_path, given, said):
    with pytest.raises(UserError, match=said):
        loop.train("bc", small_store, out=tmp_path / "runs", quiet=True, **given)
    assert not (tmp_path / "runs").exists()


def test_numbers_given_from_python_are_of_their_fields_type():
    config = build_config(icbf.Config, {"num_updates": 1e3, "batch": np.int64(7), "lr": np.float32(0.5)}, "icbf")
    assert [type(v) for v in (config.num_updates, config.batch, config.lr)] == [int, int, float]


def test_sizes_of_the_unet_are_refused_at_once(small_store):
    task = registry.from_store(small_store)
    with pytest.raises(UserError, match="depth=4 of the temporal U-Net"):
        make_job("icbf", task, "madiff-unet", {"depth": 4}, small_store)


def test_a_field_that_is_gone_is_another_config(trained, small_store, tmp_path):
    out = trained["bc"].path.parents[2]
    shutil.copytree(out / trained["bc"].config["task"] / "bc", tmp_path / trained["bc"].config["task"] / "bc")
    file = tmp_path / trained["bc"].config["task"] / "bc" / "seed-0" / "config.json"
    told = json.loads(file.read_text())
    file.write_text(json.dumps({**told, "config": {**told["config"], "momentum": 0.9}}))
    with pytest.raises(UserError, match="its momentum differs"):
        loop.train("bc", small_store, out=tmp_path, changes=TINY["bc"], quiet=True)


def test_damaged_run_folders_are_refused(tmp_path):
    run = Run(tmp_path)
    for content, said in (
        (b"[]", "is no run folder.*Expected `object`, got `array`"),
        (b"{}", "missing required field `algorithm`"),
        (b'{"algorithm": 3}', r"Expected `str`, got `int` - at `\$.algorithm`"),
        (b"\xff\xfe{", "is no run folder.*malformed"),
        (b"[" * 100_000, "is no run folder"),
        (b'{"seed": ' + b"9" * 5000, "is no run folder"),
    ):
        (tmp_path / "config.json").write_bytes(content)
        with pytest.raises(UserError, match=said):
            evaluate(run)
    for content, said in (
        (b"[]", "damaged results.json; delete .*got `array`"),
        (b"\xff", "damaged results.json"),
        (b'{"default": {"variant": 5}}', "got `int`"),
        (b'{"default": {"return_mean": NaN}}', "damaged results.json"),
        (b'{"default": {"episodes": -1}}', ">= 1"),
        (b'{"../../x": {}}', "damaged results.json"),
    ):
        (tmp_path / "results.json").write_bytes(content)
        with pytest.raises(UserError, match=said):
            run.results  # noqa: B018 (reading is what fails)
    rows = b'{"step": 1, "seconds": 0.5}\n3\n{"step": 1}\nnull\n{"step": 2, "seconds": 0.5}\n{"step": 3, "se\xff'
    (tmp_path / "metrics.jsonl").write_bytes(rows)
    assert [r["step"] for r in run.metrics] == [1, 2]


def test_no_more_is_recorded_than_was_played(trained):
    with pytest.raises(UserError, match="num_recorded=-1 must be a whole number"):
        evaluate(trained["madiff"], episodes=2, num_recorded=-1)
    evaluate(trained["madiff"], episodes=2, sampling_steps=2, num_recorded=4)
    with np.load(trained["madiff"].path / "rollout-default+sampling_steps2.npz") as kept:
        assert {len(kept[k]) for k in kept} == {2}
    _, policy = load(trained["madiff"], sampling_steps=2)  # more than are played in one batch
    played = protocol.rollout(policy, registry.get("simple_spread-random").env, protocol.CHUNK + 3, num_recorded=51)
    assert len(played["plans"]) == 51 and len(played["states"]) == protocol.CHUNK + 3


def test_what_can_be_played_is_played_and_the_others_are_named(small_store, trained, tmp_path, capsys, monkeypatch):
    from rich.console import Console

    from ringfence.cli import app

    monkeypatch.setattr(app, "out", Console(width=300))
    own = dataclasses.replace(small_store, card=small_store.card.updated(task="mine", hazard={"kind": "CostColumn"}))
    dark = loop.train("bc", own, out=tmp_path, changes={**TINY["bc"], "num_updates": 2}, quiet=True)[0]
    with pytest.raises(SystemExit) as stop:
        app.main(["eval", str(dark.path), str(trained["bc"].path), "--episodes", "2"])
    told = capsys.readouterr()
    assert stop.value.code == 2 and "Task 'mine' exists only as data" in told.err
    assert str(trained["bc"].path) in told.out and str(dark.path) not in told.out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--set", "planner=low_temperature"], "write --planner low_temperature"),
        (["--set", "checkpoint=12"], "write --checkpoint 12"),
        (["--set", "quiet=1"], "Unknown option of planner or guard 'quiet'"),
        (
            ["--sampling-steps", "3", "--set", "sampling_steps=2"],
            "3 and --set sampling_steps=2 both set sampling_steps",
        ),
        (["--set", "replan=3", "--set", "replan=2"], "--set gives replan twice, 3 and 2"),
        (["--set", "sampling_steps=3", "--set", "num_samples=2", "horizon=x"], "horizon='x' cannot be read as int"),
        (["--num-recorded", "-1"], "num_recorded=-1 must be a whole number"),
        (["--checkpoint", "3"], "no checkpoint of step 3; take one of: 6, 12"),
    ],
)
def test_options_of_eval_that_contradict_are_refused(trained, words, said, capsys):
    from ringfence.cli.app import main

    with pytest.raises(SystemExit) as stop:
        main(["eval", str(trained["madiff"].path), "--episodes", "2", *words])
    assert stop.value.code == 2 and said in capsys.readouterr().err


@pytest.fixture(scope="module")
def absolute(played):
    """Logs whose danger is about positions in the global state, which no agent observes well enough to name them; and
    as they are, no costs."""
    from ringfence.envs import SimpleSpread
    from ringfence.logs.store import EpisodeStore
    from ringfence.problem.constraints import Separation

    card = {"task": "yard", "state_names": list(SimpleSpread().state_names), "hazard": Separation(0.3)}
    noise = 0.01 * np.random.default_rng(0).normal(size=played["observations"].shape)
    arrays = played["observations"] + noise, played["actions"], played["rewards"]
    return lambda costs: EpisodeStore.from_episodes(*arrays, costs, state=played["state"], card=card)


def test_who_labels_no_states_trains_where_its_view_lacks_the_formula(played, absolute, tmp_path):
    store = absolute(played["costs"])
    run = loop.train("bc", store, out=tmp_path, changes=TINY["bc"], quiet=True)[0]
    load(run)
    task = registry.from_store(store)
    for name in ("madiff", "bc-safe", "ma-td3bc-lag", "omar"):
        assert not make_job(name, task, None, {"view": "decentralized"}, store).hazard.has_formula
    assert make_job("madiff", task, None, {"view": "centralized"}, store).hazard.has_formula
    for name in ("icbf", "fisor"):
        with pytest.raises(
            UserError, match="view 'decentralized' leaves out what the hazard Separation reads; set view="
        ):
            make_job(name, task, None, {"view": "decentralized"}, store)


@pytest.mark.parametrize("name", ["bc", "ma-td3bc", "fisor"])
def test_agents_act_by_as_many_entries_as_they_have(name, played, absolute):
    """What an agent has not is the middle of the bounds, whoever learned it."""
    store = absolute(played["costs"])
    store = dataclasses.replace(store, card=store.card.updated(action_sizes=[2, 1, 2]))
    told = {k: v for k, v in TINY[name].items() if k != "num_updates"} | {"view": "centralized"}
    job = make_job(name, registry.from_store(store), None, told, store)
    assert (
        job.spec.action_sizes == (2, 1, 2) and type(job.spec).of(json.loads(json.dumps(job.spec.to_dict()))) == job.spec
    )
    state = job.algorithm.init(jax.random.key(0), job.spec, job.config, None, job.feature_map, job.hazard)
    state = jax.tree.map(lambda x: x + 0.1 if x.dtype == jnp.float32 else x, state)  # as if it had learned
    policy = resolve.make_policy(job, state, {})
    seen, whole = store.observations[:4], store.state[:4]
    action = np.asarray(eqx.filter_jit(policy.act)(policy.initial_state(4), seen, whole, jax.random.key(0))[1].action)
    assert (action[:, 1, 1] == 0).all() and (np.abs(action[:, [0, 2]]) > 0).all() and (action[:, 1, 0] != 0).all()
    wide = store.card.updated(action_sizes=[2, 3, 2])
    with pytest.raises(UserError, match=r"action_sizes=\[2, 3, 2\]; it must say for each of the 3 agents .* 1 to 2"):
        dataclasses.replace(store, card=wide)


def test_the_cards_cost_limit_is_what_learners_keep(absolute, played):
    """Of own data; a setting overrides it, and those who keep no limit are as they were."""
    store = absolute(played["costs"])
    told = dataclasses.replace(store, card=store.card.updated(cost_limit=7.0))
    for name, field, usual in (("bc-safe", "cost_limit", 0.0), ("ma-td3bc-lag", "limit", 1.0)):
        kept = [
            getattr(make_job(name, registry.from_store(s), None, changes, s).config, field)
            for s, changes in ((store, {}), (told, {}), (told, {field: 3.0}))
        ]
        assert kept == [usual, 7.0, 3.0]
    assert make_job("bc", registry.from_store(told), None, {}, told).config.cost_limit is None
    none = dataclasses.replace(store, card=store.card.updated(cost_limit=0.0))
    with pytest.raises(UserError, match=r"limit=0.0 must be positive; .* the data's card \(cost_limit\) unless"):
        make_job("ma-td3bc-lag", registry.from_store(none), None, {}, none)


def test_costs_that_were_never_filled_in_are_refused_by_those_who_learn_from_them(absolute):
    store = absolute(None)
    task = registry.from_store(store)
    for name in ("bc-safe", "ma-td3bc-lag"):
        with pytest.raises(
            UserError, match=rf"{name} knows danger by costs alone.*calls [\d.]+ % of its states unsafe"
        ):
            make_job(name, task, None, {}, store)
    for name, view in (("bc", "decentralized"), ("icbf", "centralized")):
        make_job(name, task, None, {"view": view}, store)


def test_trained_config_round_trip(trained):
    job = resolve.load_job(trained["icbf"])
    told = trained["icbf"].config["config"]
    assert {k: v for k, v in dataclasses.asdict(job.config).items()} == told


def _asked_for(steps=400):
    """Episodes of one step, in which a reward is the first entry of the action."""
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (steps, 1, 3, 2)).astype(np.float32)
    reward = np.repeat(actions[..., 0].mean(-1)[..., None], 3, -1)
    seen = rng.normal(size=(steps, 2, 3, 4)).astype(np.float32)
    card = {"task": "asked", "action_low": -1.0, "action_high": 1.0, "episode_length": 1}
    return EpisodeStore.from_episodes(seen, actions, reward, np.zeros((steps, 1)), card=card)


def test_cloning_that_reads_returns_does_what_it_is_asked_for(tmp_path):
    """An actor that is told a high return earns more than one that is told a low one, and so does cloning the best."""
    store, earned = _asked_for(), {}
    for name, changes in {
        "high": {"target_return": 1.5},
        "low": {"target_return": -1.5},
        "best": {"best": 0.05},
    }.items():
        algorithm = "bc-return" if "target_return" in changes else "bc-best"
        changes |= {"view": "decentralized", "num_updates": 150, "width": 32, "lr": 3e-3}
        run = loop.train(algorithm, store, out=tmp_path / name, changes=changes, quiet=True)[0]
        policy = load(run)[1]
        seen = jnp.asarray(store.observations[:64])
        acted = ACT(policy, policy.initial_state(64), seen, None, jax.random.key(0))[1].action
        earned[name] = float(acted[..., 0].mean())
    assert earned["high"] > 0.2 and earned["low"] < -0.2
    assert earned["best"] > 0.2  # the mean of all is 0


def test_a_setting_that_is_given_as_an_argument_is_shown_its_place(small_store):
    with pytest.raises(UserError, match=r"num_updates is a setting of bc, not an argument; give changes="):
        loop.train("bc", small_store, num_updates=3)
