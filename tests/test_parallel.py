"""Somebody else's simulator, played through PettingZoo's parallel API: here our own, behind that face."""

from __future__ import annotations

import dataclasses
import html
import os
import shutil
import warnings

import jax
import numpy as np
import pytest

from ringfence import guard, play
from ringfence.cli import app
from ringfence.datasets.registry import TASKS
from ringfence.envs import SimpleSpread
from ringfence.envs.episode import Episode
from ringfence.envs.pettingzoo import SimpleSpreadParallel
from ringfence.errors import UserError
from ringfence.evaluation import stress
from ringfence.evaluation.certificate import Certificate
from ringfence.evaluation.certify import Foresight, certify
from ringfence.evaluation.play import play_all, simulator, simulators_of
from ringfence.evaluation.player import player_of_run, shape_of
from ringfence.faults import Faults
from ringfence.loading import resolve
from ringfence.loading.spec import PolicySpec
from ringfence.logs.collect import collect
from ringfence.training import loop, worlds
from ringfence.training.runs import Run
from ringfence.utils.progress import Progress
from ringfence.world import load as load_world
from ringfence.world import save
from tests.quick import QUICK_WORLD

TINY = {"num_updates": 2, "batch": 16, "width": 16, "depth": 1}


@pytest.fixture(scope="module")
def run(small_store, tmp_path_factory):
    """Cloning of data that nobody here simulates: another name, costs instead of a formula."""
    card = small_store.card.updated(task="mine", hazard={"kind": "CostColumn"}, cost_limit=3)
    own = dataclasses.replace(small_store, card=card)
    return loop.train("bc", own, out=tmp_path_factory.mktemp("own"), changes=TINY, quiet=True)[0]


class Watched(SimpleSpreadParallel):
    """Keeps its own books."""

    books: list[list[tuple[float, float]]] = []

    def reset(self, seed=None, options=None):
        self.kept = []
        return super().reset(seed, options)

    def step(self, actions):
        step = super().step(actions)
        if not self.kept:  # an episode begins; a reset alone may only look
            self.books.append(self.kept)
        self.kept.append((np.mean(list(step[1].values())), step[4]["agent_0"]["cost"]))
        return step


def test_what_is_summed_is_what_the_simulator_gave(run):
    Watched.books = []
    result = play(run, Watched, episodes=3, num_envs=2)
    books = np.array(Watched.books)  # (E, L, 2)
    np.testing.assert_allclose(result["per_episode"]["return"], books[..., 0].sum(1), atol=2e-3)
    np.testing.assert_allclose(result["per_episode"]["cost"], books[..., 1].sum(1))
    assert result["episodes"] == 3 and result["cost_limit"] == 3 and result["steps_mean"] == 25
    assert result["termination_rate"] == 0 and "return_norm" not in result
    alone = play(run, Watched, episodes=3, num_envs=1)  # cloning draws nothing: side by side or not is the same
    np.testing.assert_allclose(alone["per_episode"]["return"], result["per_episode"]["return"], atol=2e-3)
    charged = play(run, Watched, episodes=1, cost=lambda infos: 2.0)
    assert charged["cost_mean"] == 50

    class Apart(SimpleSpreadParallel):
        def step(self, actions):
            seen, reward, *rest = super().step(actions)
            return seen, reward, {a: 0.5 * k for k, a in enumerate(reward)}, *rest

    assert play(run, Apart, episodes=1)["cost_mean"] == 25  # the largest of costs that step() tells beside rewards


class Unseeded(SimpleSpreadParallel):
    """Begins anywhere."""

    begun = 0

    def reset(self, seed=None, options=None):
        Unseeded.begun += 1
        return super().reset(Unseeded.begun, options)


def test_a_simulator_that_ignores_its_seed_is_told(run):
    with pytest.warns(UserWarning, match=r"Unseeded begins differently at each reset\(seed=\d+\)"):
        play(run, Unseeded, episodes=1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        play(run, SimpleSpreadParallel, episodes=1)


class Own(SimpleSpreadParallel):
    """Agents see what they see, nothing says what a step costs, and the task may end by itself."""

    end = 25

    def _observations(self):
        return {
            a: x[: len(SimpleSpread().feature_map("decentralized").names)] for a, x in super()._observations().items()
        }

    def step(self, actions):
        seen, reward, terminated, truncated, infos = super().step(actions)
        self.said = [i["cost"] for i in infos.values()]
        if self._steps == self.end:
            self.agents, terminated = [], dict.fromkeys(reward, True)
        return seen, reward, terminated, truncated, dict.fromkeys(reward, {})


def test_the_hazard_counts_where_the_simulator_does_not(own_store, tmp_path):
    run = loop.train("bc", own_store, out=tmp_path, changes=TINY, quiet=True)[0]
    counted = []

    class Counted(Own):
        def step(self, actions):
            step = super().step(actions)
            counted.append(max(self.said))
            return step

    result = play(run, Counted, episodes=40, num_envs=20)
    assert 0 < result["cost_mean"] * 40 == pytest.approx(sum(counted))
    Own.end = 7
    try:
        ended = play(run, Own, episodes=4)
    finally:
        Own.end = 25
    assert ended["termination_rate"] == 1 and ended["steps_mean"] == 7

    class Mute(Own):
        def step(self, actions):
            seen, *rest = super().step(actions)
            return (seen if self.agents else {}), *rest

    with pytest.raises(UserError, match="neither a cost nor the state that an episode ends in"):
        play(run, Mute, episodes=1)


def test_a_simulator_that_does_not_fit_is_refused(run):
    def made(**names):
        return type("Odd", (SimpleSpreadParallel,), names)

    def early(self, actions):
        step = SimpleSpreadParallel.step(self, actions)
        return (*step[:2], {**step[2], "agent_1": True}, *step[3:])

    def silent(self, actions):
        return (*SimpleSpreadParallel.step(self, actions)[:4], dict.fromkeys(self.possible_agents, {}))

    def broken(self, actions):
        step = SimpleSpreadParallel.step(self, actions)
        return (step[0], dict.fromkeys(step[1], float("nan")), *step[2:])

    def gone(self, actions):
        step = SimpleSpreadParallel.step(self, actions)
        return tuple({k: v for k, v in part.items() if k != "agent_1"} for part in step)

    def wide(self):
        return dict.fromkeys(self.possible_agents, np.zeros(SimpleSpread().observation_dim))

    cases = (
        (lambda: object(), "without possible_agents; give a PettingZoo ParallelEnv"),
        (
            lambda: made(_observations=wide)(n_agents=2),
            "has 2 agents, the run was trained with 3; give a simulator of 3",
        ),
        (lambda: SimpleSpreadParallel(n_agents=2), r"shape \(2, \d+\), this run takes \(3, 18\)"),  # said first
        (made(_observations=lambda self: dict.fromkeys(self.possible_agents, np.zeros(5))), r"shape \(3, 5\)"),
        (made(step=early), "agent_1 ended at step 1 before its team"),
        (made(step=silent), "pass cost=, a function of the agents' infos"),
        (made(step=broken), "Step 1 has a reward or cost that is not finite"),
        (made(step=lambda self, actions: (1, 2)), "returned 2 things"),
        (made(reset=lambda self, seed: {}), "reset.. of Odd returned a dict; a ParallelEnv's returns two things"),
        (made(step=gone), "tells no rewards of agent_1 at step 1"),
        (made(_observations=lambda self: {}), "tells no observations of agent_0, agent_1, agent_2 at step 0"),
    )
    for make_env, said in cases:
        with pytest.raises(UserError, match=said):
            play(run, make_env, episodes=1)
    shared = SimpleSpreadParallel()
    with pytest.raises(UserError, match="gave the same SimpleSpreadParallel twice"):
        play(run, lambda: shared, episodes=2)
    with pytest.raises(UserError, match="SimpleSpreadParallel and not what makes one; give SimpleSpreadParallel"):
        play(run, shared)
    for wrong, said in (
        (5, "give the class, or a function, of a simulator"),
        (os.system, "'command'.; give a function without"),
    ):
        with pytest.raises(UserError, match=said):
            play(run, wrong)
    with pytest.raises(UserError, match="system makes no simulator by itself"):
        simulator("os:system")
    with pytest.raises(UserError, match="still is a function and no run; give ringfence.guard"):
        play(still, SimpleSpreadParallel)
    with pytest.raises(UserError, match="episodes=0 must be a whole number from 1"):
        play(run, SimpleSpreadParallel, episodes=0)
    assert resolve.load_job(run).task.cost_limit == 3


def still(observations, state):
    return np.zeros((len(observations), 3, 2))


class Odd(SimpleSpreadParallel):
    """Tells one of the five otherwise."""

    place, value = 0, None

    def step(self, actions):
        parts = list(super().step(actions))
        parts[self.place] = self.value(parts[self.place]) if callable(self.value) else self.value
        return tuple(parts)


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        *((k, None, "returned a NoneType; each of its five is a dict") for k in range(5)),
        (1, lambda r: dict.fromkeys(r, "much"), "tells the reward 'much', which is no number"),
        (1, lambda r: dict.fromkeys(r, [1, 2]), "is no number"),
        (1, lambda r: dict.fromkeys(r, float("nan")), "not finite"),
        (4, lambda i: dict.fromkeys(i, {"cost": "x"}), "tells the cost 'x'"),
        (4, lambda i: dict.fromkeys(i, {"cost": -1}), "a cost is 0 or positive"),
        (4, lambda i: dict.fromkeys(i, 3), "infos are a dict of each agent"),
        (0, lambda s: dict.fromkeys(s, "far"), "no array of numbers"),
        (3, lambda t: dict.fromkeys(t, False), "has not ended after 20 steps"),
    ],
)
def test_simulators_that_tell_nonsense(run, place, value, said):
    kind = type("Odd", (Odd,), {"place": place, "value": staticmethod(value) if callable(value) else value})
    with pytest.raises(UserError, match=said):
        play(run, kind, episodes=1, max_episode_steps=20)


def test_agents_have_names_of_their_own(run):
    class Twins(SimpleSpreadParallel):
        def __init__(self):
            super().__init__()
            self.possible_agents = ["a", "a", "b"]

    with pytest.raises(UserError, match="names an agent twice"):
        play(run, Twins, episodes=1)


def test_the_command_keeps_what_it_measured_for_reports(run, tmp_path, monkeypatch, capsys):
    """On either split, with what played, and where; the report names the command that does it again."""
    (tmp_path / "theirs.py").write_text("from ringfence.envs.pettingzoo import SimpleSpreadParallel as Theirs\n")
    folder = shutil.copytree(run.path, tmp_path / "mine" / "bc" / "seed-0")
    monkeypatch.chdir(tmp_path)
    for split in ("test", "validation"):
        app.main(["play", str(folder), "--env", "theirs.py:Theirs", "--episodes", "2", "--split", split])
    told = capsys.readouterr().out
    assert "unsafe episodes (95 % ≤)" in told and "its logs" in told
    results = Run(folder).results
    assert [*results] == ["default", "default@validation"]
    assert results["default"]["simulator"] == "theirs.py:Theirs" and results["default"]["guard"] == "none"
    app.main(["stress", str(folder), "--env", "theirs.py:Theirs", "--episodes", "2", "--delay", "2", "--split", "test"])
    (name, stressed), *_ = stress.results(Run(folder)).items()
    assert name.startswith("default in theirs.py:Theirs behind ") and stressed["simulator"] == "theirs.py:Theirs"
    behind = play(folder, SimpleSpreadParallel, episodes=2, faults={"delay": 2})
    assert stressed["per_episode"] == behind["per_episode"] and stressed["faults"] == behind["faults"]
    again = play(folder, SimpleSpreadParallel, episodes=2)
    assert again["per_episode"] != behind["per_episode"], "late actions are others"
    assert again["per_episode"] == results["default"]["per_episode"]
    assert results["default@validation"]["per_episode"] != results["default"]["per_episode"]
    app.main(["report", str(folder), "--out", "page.html"])
    page = html.unescape((tmp_path / "page.html").read_text())
    assert f"play {folder} --env THEIR.py:SIMULATOR --episodes 2" in page, "no line runs their code by being copied"
    assert "# THEIR.py:SIMULATOR is theirs.py:Theirs of whoever played" in page
    logs = Run(folder).logs
    assert f"The data itself has a return of {np.mean(logs['returns']):.1f}" in page, "beside what it was learned from"
    assert "`ringfence eval" not in page and "ringfence eval RUN" not in page, "nobody here can play it"
    for env, said in (
        ("theirs.py", "names no simulator"),
        ("other.py:Theirs", "'other.py' is no file"),
        ("theirs.py:Mine", "has no Mine that can be called"),
        ("nothing_like_it:Mine", "cannot be imported"),
    ):
        with pytest.raises(SystemExit):
            app.main(["play", str(folder), "--env", env])
        assert said in capsys.readouterr().err
    with pytest.raises(SystemExit):
        app.main(["eval", str(folder)])
    assert "--env FILE.py:NAME" in capsys.readouterr().err


def test_a_file_may_be_called_as_a_module_is(tmp_path):
    (tmp_path / "queue.py").write_text("class Mine:\n    said = 'here'\n")
    named = simulator(f"{tmp_path / 'queue.py'}:Mine")
    assert named().said == "here" and simulator(named.name)().said == "here"


@pytest.mark.parametrize(
    "command, said",
    [
        (["stress", "--delay", "2", "--guard", "shield"], "`ringfence stress RUN --env FILE.py:NAME --delay 2`"),
        (["certify", "--delay", "2", "--out", "c.json"], "a simulator of your own (--env FILE.py:NAME), or logs"),
    ],
)
def test_what_needs_a_simulator_from_here_says_what_to_do_without(run, command, said, capsys):
    name, *options = command
    with pytest.raises(SystemExit):
        app.main([name, str(run.path), *options])
    told = capsys.readouterr().err
    assert said in told and "`ringfence eval`" not in told


LIGHT = {
    "guard": "shield",
    "anyway": True,
    "horizon": 2,
    "terminal_value": False,
    "correction_steps": 2,
    "correction_restarts": 0,
}


@pytest.fixture(scope="module")
def guarded_run(small_store, tmp_path_factory):
    """Cloning of the data that the World is of."""
    return loop.train("bc", small_store, out=tmp_path_factory.mktemp("guarded"), changes=TINY, quiet=True)[0]


def test_a_run_is_certified_in_a_simulator_of_ones_own(guarded_run, small_world, tmp_path):
    Watched.books = []
    given = {"quantile": 0.5, "calibration": 2, "episodes": 3, "world": small_world, **LIGHT}
    made = certify(guarded_run, {"delay": 1}, make_env=Watched, **given)
    books = np.array(Watched.books)[..., 1]  # (E, L) costs: 2 episodes of each batch, then those that are counted
    assert len(books) == 2 * len(made.rounds) + 3
    assert made.violations == (books[-3:].sum(1) > 0).sum() and made.episodes == 3
    assert made.guard["delay"] == 1 and made.simulator.endswith(":Watched")
    assert any(f"in {made.simulator}." in line for line in made.summary())
    assert Certificate.load(made.save(tmp_path / "cert.json")) == made
    with pytest.raises(UserError, match="give one of them"):
        certify(guarded_run, {}, make_env=Watched, logs=guarded_run, **given)
    with pytest.raises(UserError, match="give make_env=, or leave cost out"):
        certify(guarded_run, {}, cost=lambda infos: 0.0, **given)


def test_what_was_foreseen_there_is_compared_with_what_came(guarded_run, small_world):
    resolved = resolve.resolve(PolicySpec.of(guarded_run, world=small_world, **LIGHT))
    guard = resolved.guard
    rows = []

    class Kept(Foresight):
        def __call__(self, now):
            rows.extend(small_world.map(*x) for x in ((now.after,) if rows else (now.before, now.after)))
            self.last = now
            super().__call__(now)

    seen = Kept(guard, False)
    with Progress("", 2, 0, quiet=True) as bar:
        player = player_of_run(resolved, "test", Faults())
        env = simulators_of(SimpleSpreadParallel, 2, player)
        play_all(player, env, range(2), jax.random.key(0), bar, [], lambda: seen)
    expected = [guard.barrier.now(a, b).min((1, 2)) for a, b in zip(rows, rows[1:])]
    np.testing.assert_allclose(np.stack(seen.came, 1), np.stack(expected, 1), rtol=1e-5, atol=1e-5)
    lacking = np.maximum(np.stack(seen.foreseen, 1) - np.stack(seen.came, 1), 0).max(1)
    np.testing.assert_array_equal(seen.shortfall(), lacking)
    decided = seen.last.decided._replace(info={"next_clearance": np.full(2, 99.0)})
    seen(seen.last._replace(decided=decided, outcome=seen.last.outcome._replace(shown=np.zeros(2, bool))))
    np.testing.assert_array_equal(seen.shortfall(), lacking, "after an episode's end nothing counts")


def test_anybodys_function_under_guard_is_played(small_world):
    """With what the guard could not do; there is no run to keep results in."""
    still = guard(
        lambda seen, state: np.zeros((3, 2)), small_world, horizon=1, correction_steps=1, correction_restarts=0
    )
    result = play(still, SimpleSpreadParallel, episodes=2)
    assert result["episodes"] == 2 and 0 <= result["infeasible_rate"] <= 1 and 0 <= result["ood_rate"] <= 1
    unsaid = play(still, Own, episodes=2)  # it tells no cost: the formula of the World's logs does
    assert unsaid["cost_mean"] == result["cost_mean"]
    alone = guard(lambda seen, state: np.zeros((3, 2)), small_world, guard="none", horizon=1)
    assert play(alone, SimpleSpreadParallel, episodes=2)["return_mean"] == pytest.approx(_at_rest(), rel=1e-5)
    with pytest.raises(UserError, match="a function under guard has none"):
        play(still, SimpleSpreadParallel, episodes=2, keep=True)
    with pytest.raises(UserError, match="rows was said to ringfence.guard"):
        play(still, SimpleSpreadParallel, episodes=2, rows=3)


def test_a_world_that_reads_observations_and_the_state(tmp_path):
    """Logs whose state tells what no observation does: their World is kept, and guards who was trained and anybody."""
    rng = np.random.default_rng(0)
    store = collect(SimpleSpreadParallel, lambda seen, state: rng.uniform(-1, 1, (3, 2)), episodes=40, quiet=True)
    world = worlds.fit(store, **QUICK_WORLD)
    assert world.map.reads == ("observations", "state") and world.map.width > max(world.widths)
    save(world, tmp_path / "kept.world")
    kept = load_world(tmp_path / "kept.world")
    run = loop.train("bc", store, out=tmp_path, changes=TINY, quiet=True)[0]
    cheap = {"horizon": 1, "correction_steps": 1, "correction_restarts": 0}
    assert play(run, SimpleSpreadParallel, episodes=2, guard="shield", world=kept, **cheap)["episodes"] == 2
    still = guard(lambda seen, state: np.zeros((3, 2)), kept, **cheap)
    assert play(still, SimpleSpreadParallel, episodes=2)["episodes"] == 2
    seen, state = store.observations[0], store.state[0]
    for given, said in (
        ((seen[:, :17], state), "observations has shape .3, 17."),
        ((seen, None), "reads the global state .18 entries., and there is none"),
        ((seen, state[:5]), "state has shape .5,."),
    ):
        with pytest.raises(UserError, match=said):
            still.act(*given)


def test_a_function_is_shown_the_state_that_its_logs_had(small_world):
    """Though the World reads observations alone; a simulator without one is played all the same."""

    class Bare(SimpleSpreadParallel):
        def state(self):
            raise NotImplementedError  # as PettingZoo's base class does

    own = dataclasses.replace(small_world, map=TASKS["simple_spread-random"].feature_map("decentralized"))
    shape = shape_of(own, 3)
    for env, state in ((SimpleSpreadParallel(), (18,)), (Bare(), None)):
        seen = Episode(env, shape, 0, 25).state
        assert (None if seen is None else seen.shape) == state
    with pytest.raises(UserError, match="reads a global state, which Bare lacks"):
        Episode(Bare(), shape_of(small_world, 3), 0, 25)


def _at_rest() -> float:
    """What nobody's moving earns in the first two episodes."""
    returns = []
    for reset in (7_000_001, 7_000_002):
        env, total = SimpleSpreadParallel(), 0.0
        env.reset(seed=reset)
        while env.agents:
            rewards = env.step({a: np.zeros(2) for a in env.agents})[1]
            total += float(np.mean(list(rewards.values())))
        returns.append(total)
    return float(np.mean(returns))


class Counts:
    """Moves by how often it was asked since its episode began."""

    def __init__(self):
        self.reset()

    def reset(self):
        self.asked = 0

    def __call__(self, seen, state):
        self.asked += 1
        return np.full((3, 2), (-1) ** (self.asked // 4))


def test_a_policy_with_a_memory_has_one_in_each_simulator(small_world):
    """However many are stepped side by side; one that cannot be copied is refused."""
    one, *others = [
        play(guard(acts, small_world, guard="none", horizon=1), SimpleSpreadParallel, episodes=3, num_envs=n)
        for acts, n in ((Counts(), 1), (Counts(), 3), (Counts().__call__, 3))
    ]
    assert all(other["per_episode"] == one["per_episode"] for other in others)

    class Held(Counts):
        def __deepcopy__(self, memo):
            raise TypeError("cannot pickle 'socket' object")

    with pytest.raises(UserError, match="Held has reset\\(\\), and so a memory, but cannot be copied .*num_envs=1"):
        play(guard(Held(), small_world, guard="none", horizon=1), SimpleSpreadParallel, episodes=2)


def test_what_a_simulator_shows_wrongly_is_said_with_where(run):
    class Blind(SimpleSpreadParallel):
        def step(self, actions):
            seen, *rest = super().step(actions)
            return seen | {"agent_1": np.where(np.arange(18) == 3, np.nan, seen["agent_1"])}, *rest

    with pytest.raises(UserError, match=r"is nan.*\(Blind, step 1 of the episode with the seed 7000001\)"):
        play(run, Blind, episodes=1)
