"""Off-policy evaluation: what logs alone say of a policy, without a simulator.

What it would do in logged states, where that leads as a World of these logs predicts it, and what it is worth, by
fitted Q evaluation (Le et al. 2019, Batch Policy Learning under Constraints) and played in that World. This World is
fitted to the logs that are given, with a seed of its own, and is not the one that guards. How far to believe each
number, where the truth is known: docs/ope.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ringfence.errors import LAST_SEED, UserError, of_kind, whole_number
from ringfence.evaluation.ope_responses import Logs, Respondent, behaviour, rollout, safety
from ringfence.evaluation.ope_result import UNKNOWN, LogsRead, Mean, OPEResult, Values
from ringfence.loading.resolve import Resolved, resolve
from ringfence.loading.spec import PolicySpec
from ringfence.logs.store import EpisodeStore
from ringfence.nets.layers import MLP
from ringfence.nets.optim import regress
from ringfence.problem.normalise import varying
from ringfence.problem.origins import Origins
from ringfence.training import worlds
from ringfence.training.runs import Run
from ringfence.types import Array, Key
from ringfence.utils.precision import in_float32, on_device
from ringfence.world import World

SAME_STEP = 0.01  # share by which two time steps may differ
STARTS = 2000  # logged starts that values are means over, at most
WIDTH = 64  # units of each of the 2 hidden layers
BEYOND = 0.5  # of the range that values can have: estimates further outside have diverged
FOLLOWS = 0.05  # rate at which the copy that targets are read from follows


@in_float32
def ope(
    run: Run | str,
    store: EpisodeStore,
    *,
    evaluation_world: World | None = None,
    states: int = 3000,
    transitions: int = 20_000,
    updates: int = 3000,
    num_ensemble: int = 5,
    discount: float = 0.95,
    ahead: int = 3,
    rollout_episodes: int = 128,
    rollout_steps: int = 100,
    planner: str = "default",
    compare: bool = True,
    seed: int = 0,
    quiet: bool = True,
    **options: Any,
) -> OPEResult:
    """What logs say of a policy: a run as `ringfence.load` plays it (guard, barrier, execution, world, ...).

    store: logs of the run's task, best those that it was not trained on (the result's `episodes_trained_on` says on how
    many of them it was). `evaluation_world` is the World that predicts (default: fitted to these logs with seed + 1).
    The policy is asked in `states` logged states; fitted Q evaluation learns from `transitions` logged steps, by
    `num_ensemble` networks on resampled episodes, whose 95 % interval is Student's; `compare` evaluates what the logs
    did, too. Policies are asked with an empty carry: plans under way and adapted margins are not there.
    In `rollout_episodes` of up to `rollout_steps` steps it is played in that World, with its carry (0 episodes: not).
    `ahead` is how many steps are predicted from each logged state.
    """
    check_sizes(states, transitions, updates, seed)
    _check(ahead, rollout_episodes, rollout_steps, num_ensemble, discount)
    run = Run.of(run)
    check(run, store)
    spec = PolicySpec.of(run, planner=planner, **options)
    resolved = _resolved(spec, store)
    world = evaluation_world or worlds.fit(store, seed=seed + 1, execution=spec.execution, quiet=quiet)
    if not (world.card.data.content == store.content and world.spec.action_dim == store.actions.shape[2]):
        raise UserError("evaluation_world is of other logs; leave it out, and one is fitted to these.")
    logs = Logs(resolved.job.task.logs(store), world)
    reads_state = logs.store.state is not None and resolved.job.widths[1] != 0  # None: it does not tell
    ask = Respondent(resolved.policy, logs, world, reads_state, ahead, seed)
    rng = np.random.default_rng(seed)
    key = jax.random.key(seed)
    asked = np.sort(rng.choice(logs.steps, min(states, logs.steps), replace=False))
    responses = ask(logs.row[asked])
    played = rollout(ask, jax.random.fold_in(key, 1), rollout_episodes, rollout_steps) if rollout_episodes else None
    learned = rng.choice(logs.steps, min(transitions, logs.steps), replace=False)
    starts = rng.permutation(logs.starts)[:STARTS]
    worth = _Worth(logs, learned, starts, FQE(discount, num_ensemble, updates), key, quiet)
    return OPEResult(
        **_about(run, resolved, logs, store),
        guard=spec.guard,
        discount=discount,
        ahead=ahead,
        behaviour=behaviour(logs, asked, responses, world),
        safety=safety(logs, asked, responses, world, ahead),
        rollout=played,
        values=worth.of_policy(ask),
        values_of_logs=worth.of_logs() if compare else None,
    )


def _check(ahead: int, rollout_episodes: int, rollout_steps: int, num_ensemble: int, discount: float) -> None:
    whole_number("ahead", ahead, 1)
    whole_number("rollout_episodes", rollout_episodes, 0)
    whole_number("rollout_steps", rollout_steps, 1)
    whole_number("num_ensemble", num_ensemble, 2, 100)
    if not 0 <= discount < 1:
        raise UserError(f"discount={discount} must be from 0 to below 1.")


@dataclass(frozen=True, eq=False)
class _Worth:
    """What actions are worth by fitted Q evaluation, from the same logged steps and first states."""

    logs: Logs
    learned: np.ndarray  # (M,) steps
    starts: np.ndarray  # (S,) rows of first states
    settings: FQE
    key: Key
    quiet: bool

    def of_policy(self, ask: Respondent) -> Values:
        following = ask(self.logs.row[self.learned] + 1).action
        first = ask(self.starts).action
        return self._fitted(following, first, "what the policy is worth")

    def of_logs(self) -> Values:
        logs = self.logs
        following = logs.actions[np.minimum(self.learned + 1, logs.last_step[self.learned])]
        first = logs.actions[logs.step_of_start[np.searchsorted(logs.starts, self.starts)]]
        return self._fitted(following, first, "what the logs are worth")

    def _fitted(self, following: np.ndarray, first: np.ndarray, label: str) -> Values:
        label = "" if self.quiet else label
        return fitted_q(self.logs, self.learned, following, self.starts, first, self.settings, self.key, label)


def _resolved(spec: PolicySpec, store: EpisodeStore) -> Resolved:
    """Who plays, as the logs want it; refused before a World is fitted to them where they lack what it reads."""
    if store.card.action_delay and spec.guarded and "delay" not in dict(spec.guard_options):
        spec = spec.with_guard_options(delay=0)  # undelayed logs, and their World, act at once
    resolved = resolve(spec)
    read = [resolved.job.feature_map] + ([] if resolved.guard is None else [resolved.guard.world.map])
    if store.state is None and any(map.reads_state for map in read):
        raise UserError("The run reads the global state, and the logs hold none; evaluate it by logs that have it.")
    return resolved


def _about(run: Run, resolved: Resolved, logs: Logs, store: EpisodeStore) -> dict[str, Any]:
    """Who was evaluated, by which logs."""
    trained_on = _trained_on(run, store)
    return {
        "task": resolved.job.task.name,
        "algorithm": resolved.job.algorithm.name,
        "logs": LogsRead(logs.episodes, logs.steps, store.content),
        "trained_on": bool(trained_on),
        "episodes_trained_on": trained_on,
    }


def _trained_on(run: Run, store: EpisodeStore) -> int | None:
    """How many of these episodes the run was trained on; None where it does not tell."""
    if run.config["data"].get("content") == store.content:
        return store.episodes
    known = run.episodes
    return None if known is None else sum(digest in known for digest in store.digests_of_episodes)


def check_sizes(states: int, transitions: int, updates: int, seed: int) -> None:
    """Refuse sizes that cannot be, before anything is fitted."""
    for name, value in (("states", states), ("transitions", transitions), ("updates", updates)):
        whole_number(name, value, 1)
    whole_number("seed", seed, 0, LAST_SEED - 1)  # the World that evaluates has the next one


def check(run: Run, store: EpisodeStore) -> None:
    """Refuse logs of another task: of another name, of other agents, entries or widths, or at another time step. All
    tables may be called the same."""
    of_kind("store", store, EpisodeStore, "give an EpisodeStore")
    config = run.config
    task = config["task"]
    if task != store.card.task:
        raise UserError(
            f"The run is of '{task}', the logs are of '{store.card.task}'; evaluate it by logs of its own task."
        )
    spec = config["spec"]
    widths = config.get("widths") or (None, None)
    homogeneous = spec.get("homogeneous", False)  # any number of them may be there
    team = None if homogeneous else config.get("team", spec["n_agents"])
    state_width = None if store.state is None or not widths[1] else widths[1]
    for what, here, there in (
        ("agents", team, store.n_agents),
        ("entries of an action", spec["action_dim"], store.actions.shape[2]),
        ("entries of an observation", widths[0], store.observations.shape[2]),
        ("entries of the state", state_width, None if store.state is None else store.state.shape[1]),
    ):
        if here is not None and here != there:
            raise UserError(f"The run is of {here} {what}, the logs of {there}; evaluate it by logs of its own task.")
    _check_names(config["data"], store)
    if Origins.of(config["data"]) != store.card.origins:
        raise UserError(
            "The logs were moved by other origins than the run's data; make both of one table, e.g. with --split."
        )
    here, there = config["data"].get("dt"), store.card.dt
    if here and there and abs(here - there) > SAME_STEP * max(here, there):
        raise UserError(
            f"The run is of steps of {here:g} s, the logs of {there:g} s; bring the logs to the run's steps."
        )


def _check_names(data: Mapping[str, Any], store: EpisodeStore) -> None:
    """Names of agents and entries that both tell must be the same, in the same order."""
    for field, there in (
        ("agents", store.card.agents),
        ("observation_names", store.card.observation_names),
        ("state_names", store.card.state_names),
    ):
        here = data.get(field)
        if not here or not there or list(here) == list(there):
            continue
        k = next((k for k, (one, other) in enumerate(zip(here, there)) if one != other), min(len(here), len(there)))
        mine, theirs = (names[k] if k < len(names) else "nothing" for names in (here, there))
        raise UserError(
            f"Entry {k} of {field} is '{mine}' in the run's data and '{theirs}' in the logs; bring them into one order."
        )


@dataclass(frozen=True)
class FQE:
    """Settings of fitted Q evaluation."""

    discount: float = 0.95
    num_ensemble: int = 5  # networks, each on episodes drawn with replacement
    updates: int = 3000


class Q(eqx.Module):
    """Q of the team, the mean over agents of networks that read an agent's view and action (of a body: everybody's);
    two outputs, return and cost."""

    net: MLP
    joint: bool = eqx.field(static=True)

    def __call__(self, x: Array, action: Array) -> Array:
        if self.joint:
            x = x[..., :1, :]
            action = action.reshape(*action.shape[:-2], 1, -1)
        return self.net(jnp.concatenate([x, action], -1)).mean(-2)


class Steps(NamedTuple):
    """Logged steps as Q learns from them; M members of the ensemble."""

    x: Array  # (T, N, D), standardised
    action: Array  # (T, N, A) logged
    next_x: Array  # (T, N, D)
    next_action: Array  # (T, N, A) of the policy that is evaluated
    earned: Array  # (T, 2) return and cost, standardised, times 1 − γ so that Q is of the order of 1
    goes_on: Array  # (T,) 0 where the task itself ended
    weight: Array  # (T, M) how often a member drew the step's episode


def fitted_q(
    logs: Logs,
    steps: np.ndarray,
    next_actions: np.ndarray,
    starts: np.ndarray,
    first_actions: np.ndarray,
    settings: FQE,
    key: Key,
    label: str = "",
) -> Values:
    """Discounted return and cost of a policy: y = r + γ Q̄(s', a'), where a' is what the policy does in s', and Q̄
    follows slowly.

    steps (T,): logged steps that Q learns from, with the policy's `next_actions` (T, N, A) in the states that they lead
    to; starts (S,): rows of first states, with its `first_actions` (S, N, A). Intervals are Student's over the
    ensemble. Progress is shown under a `label`."""
    net_key, weight_key, fit_key = jax.random.split(key, 3)
    x = np.asarray(logs.x)
    flat = x[logs.row[steps]].reshape(-1, x.shape[-1]).astype(np.float64)
    location = flat.mean(0)
    scale = varying(flat.std(0), location)

    def view(rows: np.ndarray) -> Array:
        return on_device((x[rows] - location) / scale, np.float32)

    earned = np.stack([logs.rewards[steps], logs.costs[steps]], -1).astype(np.float64)
    mean = earned.mean(0)
    deviation = np.maximum(earned.std(0), 1e-6)
    # (T, M): how often each member drew the episode of a step.
    episodes, which = np.unique(logs.episode[steps], return_inverse=True)
    rng = np.random.default_rng(int(jax.random.bits(weight_key)))
    data = Steps(
        x=view(logs.row[steps]),
        action=on_device(logs.actions[steps]),
        next_x=view(logs.row[steps] + 1),
        next_action=on_device(next_actions),
        earned=on_device((earned - mean) / deviation * (1 - settings.discount), np.float32),
        goes_on=on_device(~logs.terminated[steps], np.float32),
        weight=on_device(rng.poisson(1.0, (len(episodes), settings.num_ensemble))[which], np.float32),
    )
    agents, actions = data.next_action.shape[1:]
    sizes = (data.x.shape[-1] + (agents * actions if logs.joint else actions), WIDTH, WIDTH, 2)
    nets = jax.vmap(lambda k: Q(MLP(k, sizes, linear=True), logs.joint))(
        jax.random.split(net_key, settings.num_ensemble)
    )
    # What ends for good earns nothing more, and nothing is −mean in these units.
    fast = _fitted(nets, data, on_device(-mean / deviation, np.float32), settings, fit_key, label)
    at_starts = jax.jit(lambda nets, x, action: jax.vmap(lambda q: q(x, action).mean(0))(nets))
    found = np.asarray(at_starts(fast, view(starts), first_actions), np.float64)  # (M, 2)
    found = (found * deviation + mean) / (1 - settings.discount)
    returns, costs = (_bounded(found[:, k], earned[:, k] / (1 - settings.discount)) for k in range(2))
    return Values(returns, costs)


def _bounded(found: np.ndarray, always: np.ndarray) -> Mean:
    """The estimate, or that there is none: a sum of discounted steps lies between always earning the least that was
    logged, or nothing, and always the most; an ensemble that leaves that by far has diverged."""
    low = min(float(always.min()), 0.0)
    high = max(float(always.max()), 0.0)
    slack = BEYOND * (high - low)
    if not (np.isfinite(found).all() and low - slack <= found.mean() <= high + slack):
        return UNKNOWN
    return Mean.of_bootstrap(found)


def _fitted(nets: Q, data: Steps, nothing: Array, settings: FQE, key: Key, label: str) -> Q:
    """The ensemble after training; `nothing` (2,) is what is earned where nothing is."""

    def loss(both: tuple[Q, Q], data: Steps, pick: Array) -> Array:
        fast, slow = both
        some = Steps(*(rows[pick] for rows in data))
        q = jax.vmap(lambda net: net(some.x, some.action))(fast)  # (M, batch, 2)
        ahead = jax.lax.stop_gradient(jax.vmap(lambda net: net(some.next_x, some.next_action))(slow))
        target = some.earned + settings.discount * jnp.where(some.goes_on[:, None] > 0, ahead, nothing)
        return (some.weight.T[..., None] * (q - target) ** 2).mean()

    def follow(both: tuple[Q, Q]) -> tuple[Q, Q]:
        fast, slow = both
        return fast, jax.tree.map(lambda f, s: s + FOLLOWS * (f - s), fast, slow)

    return regress(loss, (nets, nets), data, len(data.x), key, settings.updates, 256, 1e-3, label, after=follow)[0]
