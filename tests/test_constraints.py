"""Several named constraints, each with a limit of its own: in logs, in the World, under guard and in results."""

from __future__ import annotations

import dataclasses
import re

import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.spaces import Box
from pettingzoo import ParallelEnv

from ringfence import collect, guard, play, world
from ringfence.cli import app
from ringfence.datasets.audit import audit
from ringfence.errors import StoreError, UserError
from ringfence.logs.store import EpisodeStore
from ringfence.report import build_report
from ringfence.report.table import sections
from ringfence.training import loop, worlds
from tests.quick import QUICK_WORLD

LIMITS = {"wall": 0.0, "fast": 10.0}
STEPS = 20


class Sleds(ParallelEnv):
    """Two sleds on a line each, pushed by up to 1 m/s²: beyond 1 m is a wall, and above 0.6 m/s is too fast."""

    metadata = {"name": "sleds"}
    possible_agents = ["a", "b"]

    def action_space(self, agent):
        return Box(-1.0, 1.0, (1,))

    def observation_space(self, agent):
        return Box(-np.inf, np.inf, (2,))

    def reset(self, seed=None, options=None):
        chance = np.random.default_rng(seed)
        self.x, self.v, self.t = chance.uniform(-0.8, 0.8, 2), chance.uniform(-0.5, 0.5, 2), 0
        self.agents = list(self.possible_agents)
        return self.seen(), {a: {} for a in self.agents}

    def seen(self):
        return {a: np.array([self.x[i], self.v[i]], np.float32) for i, a in enumerate(self.possible_agents)}

    def step(self, actions):
        self.v = self.v + 0.2 * np.array([float(actions[a][0]) for a in self.possible_agents])
        self.x, self.t = self.x + 0.2 * self.v, self.t + 1
        costs = {"wall": np.abs(self.x) > 1, "fast": np.abs(self.v) > 0.6}
        infos = {a: {"cost": {k: float(c[i]) for k, c in costs.items()}} for i, a in enumerate(self.possible_agents)}
        both = dict.fromkeys(self.possible_agents)
        rewards = {a: float(self.v[i]) for i, a in enumerate(self.possible_agents)}
        return self.seen(), rewards, both | dict.fromkeys(both, False), dict.fromkeys(both, self.t == STEPS), infos


def wander(observations, state):
    """Towards the middle, more or less: it is beyond the wall, or too fast, now and then, and seldom for long."""
    chance = np.random.default_rng(int(abs(observations).sum() * 1e6) % 2**32)
    pull = -0.8 * observations[:, :1] - 0.3 * observations[:, 1:]
    return np.clip(pull + chance.normal(0, 1.0, pull.shape), -1, 1)


def hurry(observations, state):
    return np.ones((2, 1), np.float32)


@pytest.fixture(scope="module")
def logs():
    names = {"observation_names": ["own.x", "own.vx"], "constraints": LIMITS, "task": "sleds", "dt": 0.2}
    return collect(Sleds, wander, episodes=250, card=names)


@pytest.fixture(scope="module")
def fitted(logs):
    settings = dict(num_ensemble=2, dynamics_updates=1500, dynamics_width=32, value_updates=50)
    return worlds.fit(logs, **settings, barrier_updates=800, barrier_width=32, future_updates=100)


def test_costs_by_name_are_kept_through_everything(logs, tmp_path):
    assert logs.constraints.shape == (250 * STEPS, 2, 2) and logs.limits == LIMITS
    assert (logs.costs == logs.constraints.max(-1)).all() and logs.card.cost_limit == 10
    x, v = np.moveaxis(logs.observations.reshape(250, STEPS + 1, 2, 2)[:, 1:], -1, 0)
    np.testing.assert_array_equal(logs.of_constraint("wall").reshape(x.shape), np.abs(x) > 1)
    np.testing.assert_array_equal(logs.of_constraint("fast").reshape(x.shape), np.abs(v) > np.float32(0.6))
    again = EpisodeStore.load(logs.save(tmp_path / "s.h5"))
    assert again.content == logs.content and list(again.limits) == list(LIMITS)
    some = again.select(np.arange(250) % 5 == 0)
    both = some.followed_by(some)
    np.testing.assert_array_equal(both.constraints[: some.steps], some.constraints)
    apart = logs.split_agents()
    np.testing.assert_array_equal(apart.of_constraint("fast")[: logs.steps], logs.of_constraint("fast")[:, 0])
    fact = audit(logs).facts["constraint wall"]
    within = 100 * (logs.episode_costs_of("wall") == 0).mean()
    assert f"{within:.1f} % of episodes are within 0" in fact and f"\nconstraint wall: {fact}\n" in str(audit(logs))


def test_costs_by_name_that_do_not_fit_are_refused(logs):
    def made(costs, limits=None):
        steps = {"observations": np.zeros((4, 2, 3)), "actions": np.zeros((4, 2, 1)), "rewards": np.zeros(4)}
        card = {} if limits is None else {"constraints": limits}
        return EpisodeStore.from_steps(
            **steps, episode_ends=[4], final_observations=np.zeros((1, 2, 3)), costs=costs, card=card
        )

    one, each = np.array([0, 1, 0, 0.0]), np.zeros((4, 2))
    mixed = made({"hit": one, "fast": each})  # the team's are everybody's
    assert mixed.costs.tolist() == [[0, 0], [1, 1], [0, 0], [0, 0]] and mixed.limits == {"hit": 0, "fast": 0}
    for costs, limits, said in (
        ({}, None, "empty dictionary"),
        ({"hit": one[:3]}, None, r"costs\['hit'\] has shape \(3,\)"),
        ({"hit": -one}, None, "holds negative entries"),
        ({"hit": one}, {"hut": 3}, "Unknown constraint with a limit 'hut'; did you mean 'hit'"),
        ({"hit": one}, {"hit": -1}, "must give each constraint's name a limit"),
        ({"a/b": one}, None, "must give each constraint's name a limit"),
        (one, {"hit": 3}, "its card names 1 \\(hit\\)"),
    ):
        with pytest.raises(UserError, match=said):
            made(costs, limits)
    with pytest.raises(StoreError, match="costs is not the largest of the constraints"):
        dataclasses.replace(logs, costs=0 * logs.costs)
    with pytest.raises(StoreError, match="name other constraints"):
        logs.followed_by(dataclasses.replace(logs, constraints=None, card=logs.card.updated(constraints=None)))
    quiet = np.array(logs.constraints)
    quiet[..., 1] = 0
    blank = dataclasses.replace(logs, constraints=quiet, costs=quiet.max(-1))
    with pytest.raises(UserError, match="No step of 'sleds' is unsafe by 'fast'"):
        worlds.fit(blank, **QUICK_WORLD)


def test_every_constraint_has_a_barrier(logs, fitted, tmp_path):
    x = jnp.asarray([[[0.0, 0.0], [1.3, 0.0]], [[0.0, 0.9], [0.0, -0.9]]])
    assert (np.asarray(fitted.barrier.apart(x, x)) < 0).tolist() == [
        [[False, False], [True, False]],
        [[False, True], [False, True]],
    ]
    np.testing.assert_allclose(fitted.barrier.of_steps(x, x), fitted.barrier.apart(x, x).min(-1))
    card = str(fitted.card)
    assert "Constraint 'wall', at most 0 per episode" in card and "Constraint 'fast', at most 10" in card
    assert min(scores.recall for scores in fitted.card.constraints.values()) > 0.9
    loaded = world.load(world.save(fitted, tmp_path / "w.safetensors"))
    np.testing.assert_array_equal(loaded.barrier.apart(x, x), fitted.barrier.apart(x, x))
    assert loaded.limits == LIMITS


def test_a_guard_keeps_all_of_them(fitted):
    """Who only accelerates is held below 0.6 m/s, and short of the wall."""
    free = guard(hurry, fitted, correction_steps=0, select=True)
    held = guard(hurry, fitted, guard="shield", horizon=5, terminal_value=False)
    loose, tight = (play(p, Sleds, episodes=10, seed=1) for p in (free, held))
    assert tight["constraints"].keys() == LIMITS.keys()
    for name, limit in LIMITS.items():
        before, after = loose["constraints"][name], tight["constraints"][name]
        assert after["limit"] == limit and after["cost_mean"] < 0.3 * before["cost_mean"]
        assert after["limit_satisfied_rate"] >= before["limit_satisfied_rate"]
    assert tight["constraints"]["fast"]["limit_satisfied_rate"] == 1.0


def test_margins_follow_the_constraint_that_was_paid(fitted, logs):
    pilot = guard(hurry, fitted, guard="adapt", adapt=0.5)
    seen = logs.observations[0] * 0
    pilot.act(seen)
    for cost, moved in (
        ({"wall": 1.0, "fast": 0.0}, [0.5, -0.125]),  # half of 10 in 20 steps, and of 0
        ({"wall": 0.0}, [0.0, -0.125]),  # of the other the guard judges by itself
        (0.0, [0.0, -0.125]),
        (1.0, [0.5, 0.375]),  # nobody judges it unsafe: it may have been any
    ):
        before = np.asarray(pilot._carry["margin"])[0]
        pilot.act(seen, cost=cost)
        np.testing.assert_allclose(np.asarray(pilot._carry["margin"])[0] - before, moved, atol=1e-5)
    with pytest.raises(UserError, match="Unknown constraint 'wal'; did you mean 'wall'"):
        pilot.act(seen, cost={"wal": 1.0})


def test_learners_keep_every_limit(logs):
    from ringfence.algos import bc

    kept = bc.within(logs, bc.Config(cost_limit=logs.card.cost_limit))
    assert 0 < kept.episodes < (logs.episode_costs <= 10).sum()
    assert (kept.episode_costs_of("wall") == 0).all() and (kept.episode_costs_of("fast") <= 10).all()


def test_results_and_reports_hold_each_beside_its_limit(logs, tmp_path, capsys):
    changes = {"num_updates": 2, "batch": 16, "width": 16, "depth": 1}
    run = loop.train("bc", logs, out=tmp_path, changes=changes, quiet=True)[0]
    found = play(run, Sleds, episodes=3, keep=True)["constraints"]
    assert {k: v["limit"] for k, v in found.items()} == LIMITS
    (data,) = sections([run])[0].references
    assert data.name == "behaviour data" and data.limits == LIMITS, "the logs are judged by each limit, too"
    assert data.episodes == logs.episodes and data.violation_rate == pytest.approx((logs.episode_costs > 0).mean())
    page = build_report([run], tmp_path / "page.html").read_text()
    shown = re.findall(r"<td>(wall|fast)</td><td>([\d.]+)</td><td>(\d+)</td>", page)
    assert shown == [(k, f"{found[k]['cost_mean']:.3f}", f"{v:g}") for k, v in LIMITS.items()]
    app.main(["play", str(run.path), "--env", "tests.test_constraints:Sleds", "--episodes", "2"])
    shown = capsys.readouterr().out
    assert "wall" in shown and "fast" in shown
    (run.path / "logs.json").write_text(
        '{"returns": [1.0], "costs": [], "steps": [], "terminated": [], "constraints": {}}'
    )
    with pytest.raises(UserError, match="holds a damaged logs.json; delete that file"):
        build_report([run], tmp_path / "page.html")


def test_simulators_that_change_their_constraints_are_refused(fitted):
    class Odd(Sleds):
        def step(self, actions):
            *transition, infos = super().step(actions)
            if self.t == 3:
                infos = {a: {"cost": self.odd(i["cost"])} for a, i in infos.items()}
            return *transition, infos

    pilot = guard(hurry, fitted)
    for odd, said in (
        (lambda c: {"wall": 0.0}, "tells costs of wall, the first one of wall, fast"),
        (lambda c: 1.0, "tells one cost, those before several"),
    ):
        Odd.odd = staticmethod(odd)
        with pytest.raises(UserError, match=said):
            play(pilot, Odd, episodes=1)


def test_columns_of_a_table_are_constraints(tmp_path, capsys):
    rows = ["t,id,run,x,y,hit,fast"]
    for run in range(4):
        for t in range(12):
            rows += [f"{t / 10},{i},{run},{t / 20 + i},{run},{int(t == 5 and i == 0)},{int(t > 8)}" for i in (0, 1)]
    (tmp_path / "fleet.csv").write_text("\n".join(rows))
    words = "data import-table fleet.csv --out fleet.h5 --time t --agent id --episode run --state x y --cost hit fast"
    given = [str(tmp_path / w) if w.startswith("fleet") else w for w in words.split()]
    app.main([*given, "--limits", "0", "2"])
    store = EpisodeStore.load(tmp_path / "fleet.h5")
    assert store.limits == {"hit": 0, "fast": 2} and store.constraints.shape == (44, 2, 2)
    assert store.episode_costs_of("hit").tolist() == [1] * 4 and store.episode_costs_of("fast").tolist() == [3] * 4
    with pytest.raises(SystemExit):
        app.main([*given, "--limits", "1"])
    assert "gives 1 numbers for 2 columns" in capsys.readouterr().err
