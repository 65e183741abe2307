"""Play a trained policy in anybody's simulator, through PettingZoo's parallel API; a command line names it."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import sys
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import jax
import numpy as np

from ringfence.envs.base import Moment, Watch, nobody, rollout, split_off
from ringfence.envs.episode import EARLY_ENDS, Cost, Episode, SideBySide, check_maker
from ringfence.errors import LAST_SEED, Interrupted, UserError, known, whole_number
from ringfence.evaluation import protocol, recordings
from ringfence.evaluation.compensation import compensated
from ringfence.evaluation.evaluate import split_words
from ringfence.evaluation.player import HasPolicy, Player, RunPlayer, player_of
from ringfence.evaluation.protocol import COUNTED, RESETS, Acting
from ringfence.evaluation.recordings import Places, filled, recording, watching
from ringfence.faults import Faults
from ringfence.problem.bounds import Bounds
from ringfence.problem.entries import Names
from ringfence.training.runs import Run
from ringfence.types import Key
from ringfence.utils import interrupts
from ringfence.utils.compilation import keep_programs
from ringfence.utils.files import writable
from ringfence.utils.progress import Progress

OF_A_BENCHMARK = ("return_norm", "cost_norm", "constants")  # parts of a summary that need a benchmark's constants


def play(
    run: Run | str | HasPolicy,
    make_env: Callable[[], Any],
    *,
    episodes: int = 20,
    planner: str = "default",
    split: str = "test",
    seed: int = 0,
    cost: Cost | None = None,
    num_envs: int = 16,
    max_episode_steps: int | None = None,
    early_ends: Literal["refuse", "cut", "skip"] = "refuse",
    faults: Faults | Mapping[str, Any] | None = None,
    compensate: bool = False,
    keep: bool = False,
    quiet: bool = True,
    **options: Any,
) -> dict[str, Any]:
    """Returns, costs and their intervals over `episodes` episodes of a simulator.

    run: a run, or a policy of anybody's under guard (`ringfence.guard`). `make_env()` makes a PettingZoo `ParallelEnv`
    whose agents, in the order of `possible_agents`, are those of the data, and who begin and end together. `num_envs`
    of them are stepped side by side, so that one compiled call acts in all. Episode k is reset with the seed 7 000 001
    + k, on the split "validation", for choosing settings, with 9 000 001 + k; one that has not ended after
    `max_episode_steps` (twenty times the longest logged one, at least 10 000) is refused; `seed` moves the policy's
    noise. `early_ends` says what becomes of an episode that an agent leaves before its team: it is refused, cut there
    (`cut_episodes` counts them), or skipped (`skipped_episodes`). A refusal's `finished` is the summary of the episodes
    that were finished before, and so is that of a Ctrl-C (`errors.Interrupted`). `planner` and `options` (guard,
    barrier, execution, world, ...) are as in `ringfence.load`. `faults` lie between policy and simulator, and
    `compensate` tells the guard of them, both as in `ringfence.stress`. `keep` adds the result to the run's
    results.json, as `ringfence eval` does, for reports, and keeps a film of the first four episodes where names tell
    where agents are (own.x and own.y, or agent0.x of the state).

    A step's reward is the mean over agents. Its cost is `cost(infos)` if that is given, else the largest of the
    agents' costs (in their infos, or the third of six results, as Safety-Gymnasium's `step` has them); costs in a
    dictionary are those of constraints by name, and the result's `constraints` has each beside its limit. Where there
    are none, 1 if the run's hazard calls the state unsafe that the step leads to.

    The summary is that of an evaluation (docs/data.md), without what needs a benchmark's constants.
    """
    keep_programs()
    _check(episodes, num_envs, seed, max_episode_steps, early_ends, split)
    faults = faults if isinstance(faults, Faults) else Faults.of(faults or {})
    player = _player(run, planner, split, options, faults, compensate, keep)
    env = simulators_of(make_env, min(num_envs, episodes), player, cost, max_episode_steps, early_ends)
    begun = time.perf_counter()
    played, watches = _played(player, env, range(RESETS[split], RESETS[split] + episodes), seed, keep, quiet)
    summary = _summary(player, played)
    about = {"task": player.task.name, "seed": seed, "eval_seconds": time.perf_counter() - begun} | player.about
    about |= {"compensated": compensate} if faults.given else {}
    if keep and isinstance(player, RunPlayer):
        how = {"split": split, "simulator": name_of(make_env, env.envs[0])}
        how |= {"num_envs": num_envs, "early_ends": early_ends}
        _keep(player, episodes, summary | about, how, watches, played)
    shown = {name: value for name, value in summary.items() if name not in OF_A_BENCHMARK}
    return shown | about | {"cost_limit": player.task.cost_limit}


def _check(episodes: int, num_envs: int, seed: int, max_episode_steps: int | None, early_ends: str, split: str) -> None:
    whole_number("episodes", episodes, 1)
    whole_number("num_envs", num_envs, 1)
    whole_number("seed", seed, 0, LAST_SEED)
    if max_episode_steps is not None:
        whole_number("max_episode_steps", max_episode_steps, 1)
    known("early_ends", early_ends, EARLY_ENDS)
    known("split", split, RESETS)


def _player(
    run: Run | str | HasPolicy,
    planner: str,
    split: str,
    options: dict[str, Any],
    faults: Faults,
    compensate: bool,
    keep: bool,
) -> Player:
    """Who plays; refused, before anything is played, where the result cannot be kept."""
    if keep and faults.given:
        raise UserError("keep=True adds to results.json, where no result has faults; leave keep or faults out.")
    if compensate:
        if isinstance(run, HasPolicy):
            raise UserError("compensate is of a run's guard; give delay, max_age and hold to ringfence.guard() itself.")
        options = compensated(run, faults, options)
    player = player_of(run, planner, split, options, faults)
    if not keep:
        return player
    if not isinstance(player, RunPlayer):
        raise UserError("keep=True adds a result to a run's folder, and a function under guard has none; leave it out.")
    _ = player.run.results
    writable(player.run.path / "results.json")
    return player


def _played(
    player: Player, env: SideBySide, resets: range, seed: int, filmed: bool, quiet: bool
) -> tuple[list[Episode], list[Places]]:
    """The episodes of these resets, and who watched the first of them where they are `filmed`. What stops it has the
    summary of those that were finished."""
    played: list[Episode] = []
    label = f"{player.name} in {type(env.envs[0]).__name__}"
    watches, watch_of = watching(_names_of(player, env.envs[0]), len(env.envs)) if filmed else ([], lambda: nobody)
    try:
        with Progress(label, len(resets), 0, quiet) as bar, interrupts.held(played):
            play_all(player, env, resets, jax.random.key(seed), bar, played, watch_of)
        return played, watches
    except UserError as error:
        if not (done := _done(played)):
            raise
        finished = f"({done} episodes were finished; the refusal's `finished` has their summary)."
        raise PlayInterrupted(f"{str(error).rstrip('.')} {finished}", _summary(player, played)) from error
    except KeyboardInterrupt as stopped:
        done = _done(played)
        summary = _summary(player, played) if done else {}
        finished = {k: v for k, v in summary.items() if k not in OF_A_BENCHMARK} | player.about if done else None
        message = f"interrupted; {done} of {len(resets)} episodes were finished, and nothing was added to results.json"
        raise Interrupted(message, finished) from stopped


def _names_of(player: Player, env: Any) -> Names:
    """What names say of entries that the player reads."""
    card = player.run.config["data"] if isinstance(player, RunPlayer) else {}
    states = card.get("state_names") if player.shape.state else None
    return Names.of(player.observation_names, states or (), len(env.possible_agents))


def _keep(
    player: RunPlayer,
    episodes: int,
    result: dict[str, Any],
    how: dict[str, Any],
    watches: Sequence[Places],
    played: Sequence[Episode],
) -> None:
    """Add a result to the run, with the command that makes it again, and the film beside it."""
    words = ["--env", how["simulator"], "--episodes", episodes, "--num-envs", how["num_envs"]]
    words += [] if how["early_ends"] == "refuse" else ["--early-ends", how["early_ends"]]
    words += [*split_words(how["split"]), *player.spec.words]
    of_file = how | {"command": ["play", *map(str, words)], "protocol": protocol.PROTOCOL, "variant": player.variant}
    player.run.add_result(player.variant, result | of_file)
    film = recording(watches, played)
    recordings.write(player.run.path, player.variant, film, len(film.get("places", ())))


class PlayInterrupted(UserError):
    """A simulator was refused while it was played; `finished` is the summary of the episodes finished before, or None
    where there is none."""

    def __init__(self, message: str, finished: dict[str, Any] | None):
        super().__init__(message)
        self.finished = finished


def _done(played: list[Episode]) -> int:
    """Episodes that were played to their end."""
    return sum(episode.over and not episode.skipped for episode in played)


def _check_bounds(env: Any, bounds: Bounds) -> None:
    """Refuse a simulator whose action spaces, where it tells them, do not hold what the policy does."""
    space_of = getattr(env, "action_space", None)
    agents = list(getattr(env, "possible_agents", ()))
    if not callable(space_of) or len(set(map(str, agents))) < len(agents):  # refused when it begins
        return
    for index, agent in enumerate(agents):
        space = space_of(agent)
        least, most = getattr(space, "low", None), getattr(space, "high", None)
        if least is None or most is None:
            continue
        mine = bounds.of_agent(index)
        try:
            narrower = (least > mine.low + mine.slack) | (most < mine.high - mine.slack)
        except ValueError:
            raise UserError(
                f"The action space of {agent} in {type(env).__name__} has shape {np.shape(least)}, and the policy is "
                f"bounded by {mine}; give the simulator that the data is of."
            ) from None
        if narrower.any():
            there = Bounds.of(np.ravel(least), np.ravel(most))
            raise UserError(
                f"The action space of {agent} in {type(env).__name__} is from {there}, the policy acts from {mine}, "
                "the bounds of its logs; give the logs the simulator's (action_low, action_high) and train anew, or "
                "scale actions in the simulator."
            )


def simulators_of(
    make_env: Callable[[], Any],
    count: int,
    player: Player,
    cost: Cost | None = None,
    max_episode_steps: int | None = None,
    early_ends: str = "refuse",
) -> SideBySide:
    """So many simulators, each its own, in which the player can act."""
    check_maker(make_env)
    envs = [make_env() for _ in range(count)]
    if len({id(env) for env in envs}) < len(envs):
        raise UserError(
            f"make_env() gave the same {type(envs[0]).__name__} twice, but several are stepped side by side; make a "
            "new one at every call, or pass num_envs=1."
        )
    _check_bounds(envs[0], Bounds(player.task.action_low, player.task.action_high))
    max_steps = max_episode_steps or max(10_000, 20 * player.episode_length)
    return SideBySide(envs, player.shape, max_steps, early_ends, cost, player.unsafe)


def play_all(
    player: Player,
    env: SideBySide,
    resets: range,
    key: Key,
    bar: Progress,
    played: list[Episode],
    watch_of: Callable[[], Watch] = lambda: nobody,
) -> None:
    """Episodes of these resets, as many at once as there are simulators. They are among `played` as soon as they have
    begun, so that who interrupts it loses none."""
    # Say so where two resets with the same seed begin differently.
    seed = resets[0]
    begun: list[np.ndarray] = []
    for _ in range(2):
        env.reset([seed])
        begun.append(env.observe().observations)
    if not np.array_equal(*begun, equal_nan=True):
        warnings.warn(
            f"{env.episodes[0].name} begins differently at each reset(seed={seed}), so that no two policies are played "
            "from the same starts; let its reset draw from that seed alone.",
            stacklevel=4,
        )
    acting = Acting(player.policy)
    keys = split_off(key)
    for first in range(0, len(resets), len(env.envs)):
        env.reset(resets[first : first + len(env.envs)])
        played.extend(env.episodes)
        if player.unsafe is not None:
            for episode, unsafe in zip(env.episodes, player.unsafe(*env.observe())):
                episode.unsafe_start = bool(unsafe)
        rollout(acting, env, _counting(env.episodes, watch_of()), keys)
        bar.advance(len(env.episodes))


def _counting(episodes: list[Episode], watch: Watch) -> Watch:
    """Who counts in which steps a guard failed, or did not know, before it is somebody else's turn to watch."""

    def count(now: Moment) -> None:
        for name in COUNTED:
            if name in now.decided.info:
                for episode, said in zip(episodes, np.asarray(now.decided.info[name]) & now.running):
                    episode.counts[name] += int(said)
        watch(now)

    return count


def _summary(player: Player, begun: list[Episode]) -> dict[str, Any]:
    """The protocol's numbers of all episodes that are over."""
    every = [episode for episode in begun if episode.over]
    played = [episode for episode in every if not episode.skipped]
    if not played:
        raise UserError(f"All {len(every)} episodes were skipped, since agents left them; pass early_ends='cut'.")
    counts = {k: np.array([e.counts[k] for e in played]) for k in played[0].counts}
    # `rewards`, `costs` (E, L), `steps`, `terminated` (E,); nothing happens after an episode's end.
    steps = np.array([len(e.rewards) for e in played])
    arrays = {
        "rewards": np.stack([filled(e.team_rewards, steps.max(), 0.0) for e in played]),
        "costs": np.stack([filled(e.team_costs, steps.max(), 0.0) for e in played]),
        "steps": steps,
        "terminated": np.array([e.terminated for e in played]),
    }
    summary = protocol.summarise(arrays | counts, player.task, np.array([e.unsafe_start for e in played]))
    if cut := sum(episode.was_cut for episode in played):
        summary["cut_episodes"] = cut
    if len(played) < len(every):
        summary["skipped_episodes"] = len(every) - len(played)
    if played[0].constraints:
        # The team's cost per episode of each.
        summary["constraints"] = {
            name: protocol.of_constraint(
                np.array([sum(float(np.max(c[name])) for c in e.constraints) for e in played]), player.limits.get(name)
            )
            for name in played[0].constraints[0]
        }
    return summary


@dataclass(frozen=True)
class NamedSimulator:
    """What makes a simulator, and the name that it was given by."""

    name: str
    make: Callable[[], Any]

    def __call__(self) -> Any:
        return self.make()


def simulator(name: str) -> NamedSimulator:
    """What makes the simulator named FILE.py:NAME or MODULE:NAME, a class or a function without arguments."""
    where, _, attribute = name.rpartition(":")
    if not where or not attribute.isidentifier():
        raise UserError(f"'{name}' names no simulator; write FILE.py:NAME or MODULE:NAME of what makes a ParallelEnv.")
    make = getattr(_imported(where, attribute), attribute, None)
    if not callable(make):
        raise UserError(
            f"'{where}' has no {attribute} that can be called; name the class, or the function, that makes one."
        )
    check_maker(make)
    return NamedSimulator(name, make)


def name_of(make_env: Callable[[], Any], env: Any = None) -> str:
    """The name a simulator was given by, else that of its class, or of what makes it."""
    if isinstance(make_env, NamedSimulator):
        return make_env.name
    made = make_env if env is None else type(env)
    return f"{made.__module__}:{getattr(made, '__qualname__', type(made).__qualname__)}"


def _of_file(file: Path) -> ModuleType:
    """The module of a file; one whose name another module has already, e.g. `queue`, gets a name of its own."""
    known = sys.modules.get(file.stem)
    if known is None or getattr(known, "__file__", None) == str(file):
        return importlib.import_module(file.stem)
    name = f"{file.stem}_{hashlib.blake2b(str(file).encode(), digest_size=4).hexdigest()}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None and spec.loader is not None, "a file that ends in .py"
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def _imported(where: str, attribute: str) -> ModuleType:
    """The module of a file, or of a name that is found from the working folder."""
    file = Path(where)
    is_file = file.suffix == ".py"
    if is_file and not file.is_file():
        raise UserError(f"'{where}' is no file; give the one that holds {attribute}.")
    sys.path.insert(0, str(file.resolve().parent if is_file else Path.cwd()))
    try:
        return _of_file(file.resolve()) if is_file else importlib.import_module(where)
    except Exception as error:  # it is anybody's code
        raise UserError(f"'{where}' cannot be imported ({type(error).__name__}: {error}); repair it first.") from error
    finally:
        sys.path.pop(0)
