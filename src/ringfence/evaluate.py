"""The evaluation protocol: fixed resets shared by all methods, raw numbers first, unsafe starts apart.

Test resets and validation resets come from disjoint keys; settings are chosen on validation, tables are made on test.
Every episode is counted; *avoidable* cost is that of the episodes that do not start unsafe.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from ringfence import algos, features, hazards, recordings, stats, tasks, training, worlds
from ringfence.each import Each, look
from ringfence.episodes import given_as
from ringfence.errors import UserError, unknown, whole_number
from ringfence.files import writable
from ringfence.guards import DANGERS, GUARDS, Guarded, GuardOptions
from ringfence.guards.policy import Paid, build, costs_of_one
from ringfence.hazards import BoundHazard
from ringfence.policies import PLANNERS, Planner, PlanOptions, plan_defaults
from ringfence.progress import Progress
from ringfence.runs import Run, build_config
from ringfence.tasks import Task
from ringfence.types import Array, Key, Policy, PyTree, Spec
from ringfence.world import World

PROTOCOL = 1  # results of different protocols are never mixed in one table
RESETS = {"test": 7_000_001, "validation": 9_000_001}  # roots of the reset keys
CHUNK = 50  # episodes per compiled batch
COUNTED = ("infeasible", "strange")  # of every step: a guard's condition could not be met; its World knew nothing there


def rollout(
    policy: Policy,
    env,
    episodes: int,
    split: str = "test",
    seed: int = 0,
    record: int = 0,
    label: str = "",
    quiet: bool = True,
) -> dict[str, np.ndarray]:
    """Play `episodes` episodes: `rewards`, `costs` (E, L) per step, `states` (E, L+1, S), `steps` (E,) taken and
    whether the task itself `terminated` (E,) it, and who was `touched` (E, L, N) where agents have costs of their own;
    the first `record` episodes also keep what the planner drew (`plans`, `chosen`). `seed` moves the policy's noise,
    never the resets."""
    if split not in RESETS:
        raise UserError(f"split='{split}' does not exist; use test or validation.")
    reset_root, act_root = jax.random.key(RESETS[split]), jax.random.fold_in(jax.random.key(RESETS[split] + 1), seed)
    if hasattr(env, "simulate"):
        return _rollout_native(policy, env, episodes, RESETS[split], act_root, record, label, quiet)

    def play(policy, index, batch, keep):
        state = env.reset(jax.random.fold_in(reset_root, index), batch)

        def step(carry, key):
            memory, state = carry
            memory, decided = policy.act(memory, env.observe(state), env.global_state(state), key)
            after, out = env.step(state, decided.action)
            memory = heard(policy, memory, out.cost)
            kept = {"reward": out.reward.mean(-1), "cost": out.team_cost, "state": env.global_state(after)}
            if out.cost.ndim == 2:
                kept["touched"] = out.cost > 0
            kept |= {name: decided.info[name] for name in COUNTED if name in decided.info}
            if keep:
                kept |= {k: v[:keep] for k, v in decided.info.items() if k not in COUNTED}
            return (memory, after), kept

        keys = jax.random.split(jax.random.fold_in(act_root, index), env.episode_length)
        _, kept = jax.lax.scan(step, (policy.start(batch), state), keys)
        kept = {k: jnp.moveaxis(v, 0, 1) for k, v in kept.items()}
        kept["state"] = jnp.concatenate([env.global_state(state)[:, None], kept["state"]], 1)
        return kept

    if _foreign(policy):
        raise UserError(
            f"Simple Spread runs inside JAX, and {type(policy).__name__} is no pytree; make it an equinox.Module whose "
            "act() uses jax.numpy."
        )
    compiled = jax.jit(play, static_argnums=(2, 3))
    chunks, done = [], 0
    with Progress(label or "evaluating", episodes, 0, quiet) as bar:
        while done < episodes:
            # Always whole chunks, so that the first n episodes are the same ones whatever number is asked for.
            keep = min(max(record - done, 0), CHUNK)
            chunks.append(jax.device_get(compiled(policy, done // CHUNK, CHUNK, keep)))
            bar.advance(min(CHUNK, episodes - done))
            done += CHUNK
    out = {k: np.concatenate([c[k] for c in chunks if k in c]) for k in chunks[0]}
    out |= {k: out[k][:episodes] for k in ("reward", "cost", "state", "touched", *COUNTED) if k in out}
    lost = ~(np.isfinite(out["reward"]) & np.isfinite(out["state"][:, 1:]).all(-1))
    if lost.any():  # nothing collides with what is nowhere, so it would pass for safe
        episode, step = np.argwhere(lost)[0]
        raise UserError(
            f"Step {step} of episode {episode} has a reward or state that is not finite, so the policy's actions are "
            "no numbers; it has diverged or divides by zero."
        )
    recorded = {k: v for k, v in out.items() if k not in ("reward", "cost", "state")}
    whole_length = {"steps": np.full(episodes, env.episode_length), "terminated": np.zeros(episodes, bool)}
    return {"rewards": out["reward"], "costs": out["cost"], "states": out["state"]} | whole_length | recorded


def _rollout_native(
    policy: Policy, env, episodes: int, root: int, key: Key, record: int, label: str, quiet: bool
) -> dict[str, np.ndarray]:
    """`rollout` on a simulator that steps outside JAX: all episodes side by side. After an episode's end its rewards
    and costs are 0 and its state stays."""
    sim = env.simulate(episodes)
    sim.reset([(root, k) for k in range(episodes)])
    act = act_with if _foreign(policy) else jax.jit(act_with)
    memory = policy.start(episodes)
    states = [sim.state().astype(np.float32)]
    steps, info, counted, lengths = [], [], [], np.zeros(episodes, int)
    with Progress(label or "evaluating", env.episode_length, 0, quiet) as bar:
        for t in range(env.episode_length):
            if not sim.running.any():
                break
            seen = sim.observe(states[-1])
            memory, decided = act(policy, memory, seen, states[-1], jax.random.fold_in(key, t))
            lengths += sim.running
            on = sim.running.copy()
            steps.append(sim.step(np.asarray(decided.action)))
            states.append(sim.state().astype(np.float32))
            memory = heard(policy, memory, steps[-1].cost)
            counted.append({k: np.asarray(decided.info[k]) & on for k in COUNTED if k in decided.info})
            if record:
                told = {k: v for k, v in decided.info.items() if k not in COUNTED}
                info.append({k: np.asarray(v[:record]) for k, v in told.items()})
            bar.advance(1)
    kept = {"rewards": np.stack([s.reward for s in steps], 1), "costs": np.stack([s.cost for s in steps], 1)}
    kept |= {k: np.stack([c[k] for c in counted], 1) for k in (counted[0] if counted else ())}
    kept = {k: _padded(v, env.episode_length) for k, v in kept.items()}
    kept |= {"steps": lengths, "terminated": np.stack([s.terminated for s in steps], 1).any(1)}
    kept["states"] = np.stack(states, 1)
    kept["states"] = np.concatenate(
        [kept["states"], np.repeat(kept["states"][:, -1:], env.episode_length + 1 - len(states), 1)], 1
    )
    return kept | ({k: np.stack([i[k] for i in info], 1) for k in info[0]} if record and info else {})


def heard(policy: Policy, memory: PyTree, cost: Array | dict[str, Array]) -> PyTree:
    """The memory of a policy that wants to know what its last step cost, (B,) or (B, N), or that by constraint."""
    return policy.hear(memory, cost) if hasattr(policy, "hear") else memory


def act_with(policy: Policy, memory: PyTree, observations: Array, state: Array | None, key: Key):
    """The policy as an argument, so that what is compiled does not hold its parameters as constants."""
    return policy.act(memory, observations, state, key)


def _foreign(policy: Policy) -> bool:
    """Whether a policy is an ordinary object that JAX cannot take apart, e.g. one around a PyTorch network."""
    return jax.tree_util.all_leaves([policy])


def _padded(x: np.ndarray, length: int) -> np.ndarray:
    """(E, length) from (E, T): nothing happens after the end."""
    return np.pad(x, ((0, 0), (0, length - x.shape[1])))


def summarise(played: dict[str, np.ndarray], task: Task, hazard_at_start: np.ndarray) -> dict:
    """The protocol's numbers from per-step rewards and costs (E, L), the episodes' steps and terminations (E,), and
    who started unsafe (E,). An episode that ends early costs little: `steps_mean`, `termination_rate` and `cost_rate`
    (cost per step played) tell."""
    returns, costs = played["rewards"].sum(1, dtype=np.float64), played["costs"].sum(1, dtype=np.float64)
    steps, terminated = played["steps"], played["terminated"]
    n, fine = len(returns), ~hazard_at_start
    violated = costs > 0
    avoidable = costs[fine] if fine.any() else np.zeros(1)
    return {
        "episodes": n,
        "return_mean": float(returns.mean()),
        "return_std": float(returns.std()),
        "return_interval": stats.bootstrap_mean(returns),
        "return_norm": float(task.normalised_return(returns.mean())),
        "cost_mean": float(costs.mean()),
        "cost_interval": stats.bootstrap_mean(costs),
        "cost_norm": float(task.normalised_cost(costs.mean())),
        "cost_cvar10": stats.cvar(costs),
        "cost_rate": float(costs.sum() / steps.sum()),
        "steps_mean": float(steps.mean()),
        "termination_rate": float(terminated.mean()),
        "violation_rate": float(violated.mean()),
        "violation_interval": stats.clopper_pearson(int(violated.sum()), n),
        "violation_upper": stats.upper_bound(int(violated.sum()), n),
        **{k: float(played[k].sum() / steps.sum()) for k in COUNTED if k in played},
        # Share of (agent, episode) with a cost of the agent's own.
        **({"agent_violation_rate": float(played["touched"].any(1).mean())} if "touched" in played else {}),
        "unsafe_starts": int(hazard_at_start.sum()),
        "avoidable_cost": float(avoidable.mean()),
        "avoidable_interval": stats.bootstrap_mean(avoidable),
        "avoidable_violation_upper": stats.upper_bound(int((avoidable > 0).sum()), len(avoidable)),
        "constants": {
            "return_min": task.return_min,
            "return_max": task.return_max,
            "cost_limit": task.cost_limit,
            "cost_offset": task.cost_offset,
        },
        "per_episode": {
            "return": [round(float(x), 3) for x in returns],
            "cost": [float(x) for x in costs],
            "unsafe_start": [bool(x) for x in hazard_at_start],
            "steps": [int(x) for x in steps],
            "terminated": [bool(x) for x in terminated],
        },
    }


def complete(result: dict, task: Task) -> bool:
    """Whether a stored result says all that the protocol asks for: how many episodes ended early is younger than
    results there are, which matters only where they can."""
    return "termination_rate" in result or task.env is None or not task.env.terminates


def of_last_step(result: dict, config: dict) -> bool:
    """Whether a stored result is of a run's last step, by its config; a foreign one may tell none."""
    steps = config.get("steps")
    return steps is None or result.get("step", steps) == steps


def unsafe_starts(task: Task, states: np.ndarray) -> np.ndarray:
    """(E,) whether the first state (E, S) of an episode is already unsafe for anyone."""
    view = task.feature_map("pruned")
    bound = hazards.bind(task.hazard, view.names, view.plus.shape[0])
    seen = None if view.source == "state" else task.env.observe(task.env.from_global_state(jnp.asarray(states)))
    unsafe, _ = bound.labels(jnp.asarray(look(view, task.alike, seen, states)))
    return np.asarray(unsafe.reshape(len(states), -1).any(-1))


def evaluate_policy(
    policy: Policy,
    task: Task,
    episodes: int = 200,
    split: str = "test",
    seed: int = 0,
    record: int = 0,
    label: str = "",
    quiet: bool = True,
) -> tuple[dict, dict[str, np.ndarray]]:
    """(summary, what was recorded) of a policy on a task's simulator. Robots are played by any object with `start` and
    `act` (types.Policy); Simple Spread, which runs inside JAX, by pytrees."""
    if task.env is None:
        raise UserError(
            f"Task '{task.name}' exists only as data, so `ringfence eval` has nothing to play in; play in a simulator "
            "of your own: `ringfence play RUN --env FILE.py:NAME`."
        )
    episodes, record = whole_number("episodes", episodes, 1, 10**7), whole_number("record", record)
    record = min(record, episodes)
    begun = time.perf_counter()
    played = rollout(policy, task.env, episodes, split, seed, record, label, quiet)
    result = summarise(played, task, unsafe_starts(task, played["states"][:, 0]))
    result |= {"protocol": PROTOCOL, "task": task.name, "split": split, "seed": seed}
    return result | {"eval_seconds": time.perf_counter() - begun}, played


def load(run: Run | str, step: int | None = None, planner: str = "plain", **options):
    """(job, policy) of a finished run.

    `planner` is a named set of options of those who draw plans (policies.PLANNERS), `guard` one of guards
    (guard.GUARDS), `danger` what the guard knows danger by, `sight` whether it sees the whole team ("all") or every
    agent guards its own action by its own view ("own", the only one of agents who are alike), `world` the World it
    reads (default: that of the run's data and seed), `agents` how many play, where they are alike. Other options are
    fields of PlanOptions and GuardOptions. The policy's `act` is a pure function: compile it with jax.jit, or use a
    `Controller`.
    """
    job, policy, _ = loaded(run, step, asked(planner, **options))
    return job, of_team(job, policy)


def of_team(job: training.Job, policy: Policy) -> Policy:
    """A job's policy as its whole team plays it."""
    return Each(policy, job.team) if job.task.alike else policy


@dataclasses.dataclass(frozen=True)
class Asked:
    """How a run is to be played."""

    planner: str
    guard: str
    danger: str
    sight: str | None
    world: World | str | Path | None
    agents: int | None  # who play, where they are alike; None: as many as in the logs
    plan: dict  # options of the planner
    given: dict  # options of the guard

    @property
    def guarded(self) -> bool:
        return self.guard != "none" or bool(self.given)


def asked(
    planner: str = "plain",
    guard: str = "none",
    danger: str | None = None,
    sight: str | None = None,
    world: World | str | Path | None = None,
    agents: int | None = None,
    **options,
) -> Asked:
    """Names and options sorted to whom they belong; unknown ones are refused."""
    for kind, name, known in (
        ("planner", planner, PLANNERS),
        ("guard", guard, GUARDS),
        ("sight", sight or "all", ("all", "own")),
    ):
        if name not in known:
            raise unknown(kind, str(name), known)
    if danger is not None and danger not in DANGERS:
        raise unknown("danger", str(danger), DANGERS)
    fields = {f.name for f in dataclasses.fields(GuardOptions)}
    given = {k: v for k, v in options.items() if k in fields}
    plan = {k: v for k, v in options.items() if k not in fields}
    for name in plan:
        if name not in (names := {f.name for f in dataclasses.fields(PlanOptions)}):
            raise unknown("option of planner or guard", name, names | fields)
    if agents is not None:
        whole_number("agents", agents, 1, 100_000)
    found = Asked(planner, guard, danger or "learned", sight, world, agents, plan, given)
    if not found.guarded and (danger is not None or sight == "own" or world is not None):
        told = next(k for k, v in (("danger", danger), ("sight", sight == "own"), ("world", world)) if v)
        raise UserError(f"{told} is read by nothing without a guard; name one with guard=, e.g. shield.")
    return found


def loaded(run: Run | str, step: int | None, how: Asked) -> tuple[training.Job, Policy, int]:
    """(job, policy, step of the checkpoint); of agents who are alike, the policy of each."""
    run = Run.of(run)
    job = load_job(run, how.agents)
    world = worlds.of_run(run) if job.reads_world else None
    told = {} if world is None else {"world": world}

    def blank():
        state = job.algorithm.init(jax.random.key(0), job.spec, job.config, None, job.feature_map, job.hazard, **told)
        return training.learned(state)

    at, state = run.load_checkpoint(jax.eval_shape(blank), step)
    if world is not None:
        state |= {"world": job.algorithm.of_world(world, job.config)}
    policy = make_policy(job, state, {**PLANNERS[how.planner], **how.plan})
    if how.guarded:
        sight = worlds.sight_of(job.task, how.sight)
        world = worlds.for_guard(run, sight, how.world, read=world, quiet=False)
        usual = None if job.task.env is None else job.task.guard  # own data is judged by what its card says
        policy = build(policy, world, job.hazard.hazard, how.guard, how.danger, usual, **how.given)
    return job, policy, at


class Controller:
    """A trained policy at run time: one environment, NumPy in, NumPy out, compiled at its first action.

    controller = Controller("runs/…/seed-0", guard="shield", danger="learned")
    controller.reset()                             # at the start of every episode
    action = controller.act(observations, state)   # (N, O), (S,) or None -> (N, A)

    `info` says of the last action what the policy knows of it, e.g. `strange`: the World knows nothing there. Not for
    several threads at once.
    """

    def __init__(self, run: Run | str, planner: str = "plain", seed: int = 0, **options):
        self.job, self.policy = load(run, planner=planner, **options)
        self._key = jax.random.key(whole_number("seed", seed, 0, 2**31 - 1))
        self._act = jax.jit(act_with)
        self.info: dict[str, np.ndarray] = {}
        self.reset()

    def reset(self) -> None:
        """Begin an episode: plans in progress and histories are forgotten."""
        self._memory = self.policy.start(1)

    def act(self, observations: np.ndarray, state: np.ndarray | None = None, cost: Paid | None = None) -> np.ndarray:
        """(N, A) joint action within the task's bounds; `cost` is what the last step cost, in all or by each
        constraint's name, which an adapting guard follows. Arrays of another shape than the run's are refused, and so
        is what is not finite: indices beyond an array's end would be clipped in silence, and noise would follow
        NaN."""
        width, state_width = self.job.widths
        seen = given_as("observations", observations, (self.job.team, width))
        if state is not None and state_width == 0:
            raise UserError(
                "This run's data has no global state, but act() was given one; pass the observations alone."
            )
        view = self.job.feature_map
        if state is None and view.source == "state":
            raise UserError(
                f"act() got no state, but this run's view '{view.view}' reads it; pass the global state"
                + (f" ({state_width} entries)." if state_width else ".")
            )
        whole = None if state is None else given_as("state", state, (state_width,))
        if None in self.job.widths:
            self._reaches(seen, whole)
        self._key, key = jax.random.split(self._key)
        whole = None if whole is None else whole[None]
        if cost is not None:
            self._memory = heard(self.policy, self._memory, costs_of_one(cost))
        self._memory, step = self._act(self.policy, self._memory, seen[None], whole, key)
        self.info = {k: np.asarray(v[0]) for k, v in step.info.items()}
        return np.asarray(step.action[0])

    def _reaches(self, seen: np.ndarray, state: np.ndarray | None) -> None:
        """Refuse arrays too short for the entries that the run reads; runs of own data once told no widths."""
        view, last = self.job.feature_map, int(self.job.feature_map.plus.max())
        name, there = "observations", seen.shape[-1]
        if view.source == "state":
            name, there = "state", last + 1 if state is None else len(state)
        elif state is not None:
            name, there = "observations and state", there + len(state)
        if last >= there:
            raise UserError(f"{name} has {there} entries, this run reads entry {last}; pass what its data holds.")


def load_job(run: Run, agents: int | None = None) -> training.Job:
    """The job that a run folder holds, rebuilt from its config.json; played by another number of `agents` where they
    are alike."""
    told = run.config
    lacking = [name for name in ("spec", "feature_map") if name not in told]
    if lacking:
        raise UserError(f"'{run.path / 'config.json'}' lacks '{lacking[0]}', so nothing can be played; train it again.")
    algorithm = algos.get(told["algorithm"])
    config = build_config(algorithm.Config, told["config"], algorithm.name)
    fields = {f.name for f in dataclasses.fields(Spec) if f.default is dataclasses.MISSING}
    if lacking := sorted(fields - set(told["spec"])):
        raise UserError(f"'{run.path / 'config.json'}' has a spec without '{lacking[0]}'; train the run again.")
    spec = Spec.of(told["spec"])
    if told["feature_map"] is None:
        # Danger is what the run's data said it is, as in training.
        task = tasks.simulated(told["task"], hazards.from_dict(told["hazard"]))
        if task is None:
            raise unknown("task", told["task"], tasks.TASKS)
        feature_map, team = task.feature_map(config.view), task.env.n_agents
        widths = training.widths_of(task)
    else:
        card = told["data"]
        task = Task(
            told["task"],
            None,
            hazards.from_dict(told["hazard"]),
            cost_limit=float(card.get("cost_limit", 1.0)),
            action_low=card["action_low"],
            action_high=card["action_high"],
            alike=spec.alike,
        )
        feature_map, team = features.from_dict(told["feature_map"]), told.get("team", spec.n_agents)
        named = (card.get("observation_names"), card.get("state_names"))
        widths = tuple(told.get("widths") or (len(names) if names else None for names in named))
    if agents not in (None, team):
        task, team = tasks.of_team(task, agents), agents
    hazard: BoundHazard = hazards.bind(hazards.from_dict(told["hazard"]), spec.feature_names, spec.n_agents)
    return training.Job(algorithm, told["preset"], config, task, spec, feature_map, hazard, widths, team=team)


def make_policy(job: training.Job, state, options: dict) -> Policy:
    """The policy of a trained state with evaluation-time options (ignored by algorithms that do not plan)."""
    chosen = build_config(PlanOptions, {**plan_defaults(job.config), **options}, "the planner")
    return job.algorithm.make_policy(state, job.config, job.spec, job.feature_map, job.hazard, chosen)


def variant_name(job: training.Job, policy: Policy, how: Asked, split: str) -> str:
    """Preset, named planner, guard with its danger and sight, and the values of the options given beside them, e.g.
    `split+climbing+shield-learned+rows7`. Neither their order nor how their values were spelled makes another name."""
    inner = policy.proposal if isinstance(policy, Guarded) else policy
    name, plans = job.preset, isinstance(inner, Planner)
    if plans and how.planner != "plain":
        name += f"+{how.planner}"
    if isinstance(policy, Guarded):
        own = how.sight == "own" and not job.task.alike
        name += f"+{how.guard}-{how.danger}" + ("-own" if own else "")
    for options, given in ((inner.options if plans else None, how.plan), (_guard_of(policy), how.given)):
        for field in dataclasses.fields(options) if options is not None else ():
            if field.name in given:
                value = getattr(options, field.name)
                name += f"+{field.name}{float(value) if isinstance(field.default, float) else value}"
    name += "" if how.agents is None else f"+agents{how.agents}"
    return name if split == "test" else f"{name}@{split}"


def _guard_of(policy: Policy) -> GuardOptions | None:
    return policy.guard.options if isinstance(policy, Guarded) else None


def evaluate(
    run: Run | str,
    *,
    episodes: int = 200,
    split: Literal["test", "validation"] = "test",
    planner: str = "plain",
    record: int = 0,
    quiet: bool = True,
    step: int | None = None,
    **options,
) -> dict:
    """Evaluate a run folder and add the result to its results.json, under the variant's name.

    `planner`, `guard`, `danger`, `sight`, `world` and other options are as in `load`. The result tells the `step` of
    the checkpoint that was played; where training is unfinished, a line on stderr says so.
    """
    run, how = Run.of(run), asked(planner, **options)
    whole_number("episodes", episodes, 1, 10**7)
    whole_number("record", record)
    job, policy, at = loaded(run, step, how)
    _ = run.results, writable(run.path / "results.json")  # what cannot be kept is refused before anything is played
    if step is None and at < job.config.steps:
        print(f"'{run.path}' is at step {at} of {job.config.steps}; its training is unfinished.", file=sys.stderr)
    variant = variant_name(job, policy, how, split)
    variant += "" if step is None else f"@step{step}"
    seed = run.config["seed"]
    label = f"{job.algorithm.name} {variant} {job.task.name} seed {seed}"
    result, played = evaluate_policy(of_team(job, policy), job.task, episodes, split, seed, record, label, quiet)
    result |= {"variant": variant, "step": at} | about(run, job, policy, how)
    run.add_result(variant, result)
    recordings.write(run.path, variant, played, record)
    return result


def about(run: Run, job: training.Job, policy: Policy, how: Asked) -> dict:
    """What a result says of who played: algorithm, planner, guard, with all their options."""
    inner, guards = policy.proposal if isinstance(policy, Guarded) else policy, _guard_of(policy)
    plans = isinstance(inner, Planner)
    return {
        "algorithm": job.algorithm.name,
        "provenance": run.config["data"]["provenance"],
        "planner": how.planner if plans else "plain",
        "options": dataclasses.asdict(inner.options) if plans else {},
        "guard": how.guard if guards else "none",
        "danger": how.danger if guards else "none",
        "sight": worlds.sight_of(job.task, how.sight),
        "agents": job.team,
        "guard_options": dataclasses.asdict(guards) if guards else {},
        **({"world_settings": policy.guard.world.card["settings"]} if guards else {}),
        "train_seconds": sum(r["seconds"] for r in run.metrics),
        "parameters": _parameters(policy),
    }


def _parameters(policy: Policy) -> int:
    return int(sum(np.size(x) for x in jax.tree.leaves(policy)))


def _first(env) -> tuple[Array, Array]:
    """What a policy sees at the start of an episode: (1, N, O), (1, S)."""
    if hasattr(env, "simulate"):
        sim = env.simulate(1)
        sim.reset([0])
        return jnp.asarray(sim.observe(), jnp.float32), jnp.asarray(sim.state(), jnp.float32)
    state = env.reset(jax.random.key(0), 1)
    return env.observe(state), env.global_state(state)


def plan_latency(policy: Policy, task: Task, calls: int = 200) -> dict[str, float]:
    """Milliseconds for one joint action in one environment: p50 and p99 over `calls`, after warm-up."""
    seen = _first(task.env)
    act = jax.jit(lambda policy, memory, seen, key: policy.act(memory, *seen, key)[1].action)
    memory, keys = policy.start(1), jax.random.split(jax.random.key(1), calls + 10)
    took = []
    for key in keys:
        begun = time.perf_counter()
        act(policy, memory, seen, key).block_until_ready()
        took.append((time.perf_counter() - begun) * 1e3)
    p50, p99 = np.percentile(took[10:], [50, 99])
    return {"plan_ms_p50": float(p50), "plan_ms_p99": float(p99)}
