"""Play episodes: batched, compiled where the simulator is, the same resets for everybody."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ringfence.envs.base import NativeEnv
from ringfence.errors import UserError
from ringfence.proposals.base import act_with, heard
from ringfence.types import Key, Policy
from ringfence.utils.progress import Progress

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
    whether the task itself `terminated` (E,) it, and who was `violated` (E, L, N) where agents have costs of their own;
    the first `record` episodes also keep what the planner drew (`plans`, `chosen`). `seed` moves the policy's noise,
    never the resets."""
    if split not in RESETS:
        raise UserError(f"split='{split}' does not exist; use test or validation.")
    reset_root, act_root = jax.random.key(RESETS[split]), jax.random.fold_in(jax.random.key(RESETS[split] + 1), seed)
    if isinstance(env, NativeEnv):
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
                kept["violated"] = out.cost > 0
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
    out |= {k: out[k][:episodes] for k in ("reward", "cost", "state", "violated", *COUNTED) if k in out}
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


def _foreign(policy: Policy) -> bool:
    """Whether a policy is an ordinary object that JAX cannot take apart, e.g. one around a PyTorch network."""
    return jax.tree_util.all_leaves([policy])


def _padded(x: np.ndarray, length: int) -> np.ndarray:
    """(E, length) from (E, T): nothing happens after the end."""
    return np.pad(x, ((0, 0), (0, length - x.shape[1])))
