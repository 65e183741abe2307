"""Logs of machines whose commands take effect some steps late: how many, by the logs alone, and the logs as they would
be if every step held the command that moved it.

Of each agent, what an entry changes by in a step is explained linearly by where it is, by its last change, and by the
command of so many steps before, alone and times where it is. The last change tells of motion that goes on, so that a
slow body is not taken for a late one. What that gains on held-out episodes has its summit at the delay. Commands that
vary slowly tell of each other, so a late one also has to tell clearly more beyond that of the step than the other way
round.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ringfence.errors import StoreError, of_kind, whole_number
from ringfence.logs.store import EpisodeStore

LONGEST = 10  # steps of a delay that is looked for
CLEARLY = 2.0  # times what the command of the step itself adds to a late one, which that has to add to it
LITTLE = 0.05  # of one entry's change: what explains less is nobody's command
MUCH = 0.3  # of one entry's change, which a late command has to explain: chance does less, in short logs, too
STEPS = 4_000  # of each agent that are looked at, at most
AGENTS = 4  # that are looked at, at most
ENTRIES = 100  # of observations and of commands that are looked at, at most
PRODUCTS = 400  # of entries and commands, at most; where there are more, commands are looked at alone
NOTHING = 1e-6  # of an entry's variance: where less is left without commands, none explains it
FLAT = 1e-6  # of its size: an entry that varies by less does not
FEWEST = 200  # steps, below which nothing is said
HELD_OUT = 3  # every so many-th episode, or stretch of steps where there are few
RIDGE = 1e-4  # of the number of steps


@dataclass(frozen=True)
class Lateness:
    """Steps after which each agent's commands take effect by its logs, (N,); None of one that tells nothing."""

    steps: tuple[int | None, ...]

    @property
    def any(self) -> bool:
        """Whether somebody's take effect late."""
        return any(self.steps)

    @property
    def of_all(self) -> int:
        """That of the team; 0 where agents differ."""
        told = {late for late in self.steps if late is not None}
        return told.pop() if len(told) == 1 else 0

    def __str__(self) -> str:
        if self.of_all:
            return f"{self.of_all} step{'s' if self.of_all > 1 else ''} late"
        return ", ".join(f"{late} steps late of agent {i}" for i, late in enumerate(self.steps) if late is not None)

    @property
    def remedy(self) -> str:
        """What helps a World of such logs."""
        if self.of_all:
            return f"undelay the logs (`ringfence data undelay --delay {self.of_all}`)"
        return "log what each agent did at the step that it moved"


def lateness(store: EpisodeStore) -> Lateness:
    """How late commands take effect, as the logs tell it."""
    some = set(np.unique(np.linspace(0, store.n_agents - 1, AGENTS).astype(int)).tolist())
    return Lateness(tuple(_of_agent(store, i) if i in some else None for i in range(store.n_agents)))


def late_actions(store: EpisodeStore) -> list[str]:
    """A warning where commands take effect late: a World that takes them to act at once predicts poorly."""
    late = lateness(store)
    return [f"Commands take effect {late}, as what agents do tells: {late.remedy}."] if late.any else []


def undelay(store: EpisodeStore, delay: int) -> EpisodeStore:
    """The logs as they would be if commands took effect at once: each step has the command that was sent `delay` steps
    before. The first `delay` steps of each episode, whose commands nobody knows, are left out, and so are episodes that
    are no longer. The card's `action_delay` says so, and a guard by a World of these logs decides for so much later."""
    of_kind("store", store, EpisodeStore, "give an EpisodeStore")
    whole_number("delay", delay, 1, LONGEST)
    if store.card.action_delay:
        raise StoreError(
            f"The logs of '{store.card.task}' were undelayed by {store.card.action_delay} steps before; undelay what "
            "they were made of."
        )
    long = store.lengths > delay
    if not long.any():
        raise StoreError(f"No episode of '{store.card.task}' is longer than {delay} steps; undelay by less.")
    lost = int((~long).sum())
    logs = store.select(long) if lost else store
    within = _within_episode(logs)
    kept = np.flatnonzero(within >= delay)
    rows = np.delete(np.arange(len(logs.observations)), (logs.first_rows[:, None] + np.arange(delay)).ravel())
    notes = list(logs.card.warnings)
    if lost:
        notes.append(f"{lost} episodes of {delay} steps or fewer were left out by undelaying")
    card = logs.card.updated(action_delay=delay, warnings=notes)
    late = logs.taken(rows, kept, np.cumsum(logs.lengths - delay))
    return replace(late, actions=logs.actions[kept - delay], card=card)


def _within_episode(store: EpisodeStore) -> np.ndarray:
    """(T,) steps of its episode before each step."""
    return np.arange(store.steps) - np.repeat(store.episode_ends - store.lengths, store.lengths)


def _of_agent(store: EpisodeStore, agent: int) -> int | None:
    """Steps after which one agent's commands take effect; None where its logs do not tell."""
    steps = np.flatnonzero(_within_episode(store) >= LONGEST)
    if len(steps) > STEPS:
        steps = steps[np.linspace(0, len(steps) - 1, STEPS).astype(int)]
    if len(steps) < FEWEST:
        return None
    explained = _Explained.of(store, agent, steps)
    gains = np.stack([explained.by(late) for late in range(LONGEST + 1)])
    if not gains.size or gains.max() < LITTLE:
        return None
    late = int(np.where(gains < LITTLE, 0.0, gains).sum(1).argmax())
    if late == 0 or gains[late].max() < MUCH:
        return 0
    # Commands that vary slowly tell of each other: what counts is what one tells beyond the other.
    beyond, behind = (explained.by(one, other).clip(0).sum() for one, other in ((late, 0), (0, late)))
    return late if beyond > max(CLEARLY * behind, LITTLE) else 0


@dataclass(frozen=True, eq=False)
class _Explained:
    """What commands of so many steps before explain (D,) of entries' changes, on held-out steps."""

    known: np.ndarray  # (M, ...) where the agent is, and its last change
    x: np.ndarray  # (M, X) where it is
    change: np.ndarray  # (M, D)
    actions: np.ndarray  # (M, 1 + LONGEST, A), those of so many steps before
    out: np.ndarray  # (M,) bool, held out

    @classmethod
    def of(cls, store: EpisodeStore, agent: int, steps: np.ndarray) -> _Explained:
        episode = store.episode_of_step[steps]
        rows = steps + episode
        before, now, after = (_some_entries(store.observations[rows + k, agent].astype(np.float64)) for k in (-1, 0, 1))
        x, last = _standardised(now), _standardised(now - before)
        known = np.concatenate([np.ones((len(steps), 1)), x, last], 1)
        blocks = episode if len(np.unique(episode)) >= 2 * HELD_OUT else np.arange(len(steps)) * 30 // len(steps)
        _, blocks = np.unique(blocks, return_inverse=True)
        actions = _some_entries(store.actions[steps[:, None] - np.arange(LONGEST + 1), agent].astype(np.float64))
        out = blocks % HELD_OUT == HELD_OUT - 1
        return cls(known, x, _standardised(after - now), actions, out)

    def by(self, late: int, *beyond: int) -> np.ndarray:
        """What the command of so many steps before adds (D,) beyond those of others, as a share of what is left without
        any; 0 where nothing is."""
        before = self._left(*beyond) if beyond else self._alone
        nothing = self._alone < NOTHING * self.out.sum()
        return np.where(nothing, 0.0, (before - self._left(late, *beyond)) / np.where(nothing, 1.0, self._alone))

    @cached_property
    def _alone(self) -> np.ndarray:
        return self._left()

    def _left(self, *late: int) -> np.ndarray:
        """Squared error (D,) by the commands of so many steps before: of the least squares fit to the other steps, on
        those held out."""
        told = [self.known]
        for k in late:
            action = _standardised(self.actions[:, k])
            told.append(action)
            if action.shape[1] * self.x.shape[1] <= PRODUCTS:  # what commands do where a body heads elsewhere
                told.append((action[:, :, None] * self.x[:, None, :]).reshape(len(action), -1))
        x, y = np.concatenate(told, 1), self.change
        fitted = x[~self.out]
        weights = np.linalg.solve(fitted.T @ fitted + RIDGE * len(x) * np.eye(x.shape[1]), fitted.T @ y[~self.out])
        return ((y[self.out] - x[self.out] @ weights) ** 2).sum(0)


def _some_entries(x: np.ndarray) -> np.ndarray:
    """At most so many entries (..., D), evenly spread."""
    return x if x.shape[-1] <= ENTRIES else x[..., np.linspace(0, x.shape[-1] - 1, ENTRIES).astype(int)]


def _standardised(x: np.ndarray) -> np.ndarray:
    """Entries that vary, with mean 0 and deviation 1."""
    x = x[:, x.std(0) > FLAT * np.abs(x).max(0)]
    return (x - x.mean(0)) / x.std(0)
