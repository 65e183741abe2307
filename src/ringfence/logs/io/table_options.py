"""How a table is written, what its columns are, how rows become episodes. The command line reads these classes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class Columns:
    """Columns of a table, in SI units."""

    time: str = "time"
    """column of times, s (or of dates)."""
    time_unit: float | None = None
    """seconds of one, where times are something else, e.g. 0.001 of ms, 0.04 of frames at 25 a second."""
    agent: str = "agent"
    """column that tells agents apart."""
    state: tuple[str, ...] = ()
    """columns of where an agent is (x y z), how it moves (vx vy vz) and what else it knows of itself, SI units."""
    episode: str | None = None
    """column that tells recordings apart."""
    action: tuple[str, ...] = ()
    """columns of what it was commanded to do until its next row; accelerations by default."""
    reward: str | None = None
    """column of what it earned since its row before; progress to the goal by default, or nothing."""
    cost: tuple[str, ...] = ()
    """column of danger since its row before, 0 or above; several are constraints of these names."""
    terminated: str | None = None
    """column of flags, 1 on the row with which an episode ended by itself, not by a time limit."""
    goal: tuple[str, ...] = ()
    """columns of where it is to go, as many as its position has."""
    wide: str | None = None
    """how a file with columns for every agent calls them, e.g. {agent}_{column} of leader_x and follower_x."""


@dataclass(frozen=True, kw_only=True)
class EpisodeRules:
    """How rows of agents and times become episodes."""

    dt: float | None = None
    """s, of the store's steps; that of the rows by default."""
    gap: float | None = None
    """s without a row, after which an agent was away; five steps by default."""
    team: int | None = None
    """agents of an episode; by default as many as most rows have."""
    neighbours: int | None = None
    """episodes of one agent each, who sees so many others; one policy for any number of them."""
    sensing_radius: float | None = None
    """m, how far such an agent sees."""
    min_episode_steps: int = 5
    """steps of an episode, at least."""
    max_episode_steps: int | None = None
    """steps of an episode, at most; longer ones are cut."""
    max_speed: float | None = None
    """m/s that nothing there can do: rows that jump faster are dropped. Without it, 100 m/s are refused."""


@dataclass(frozen=True, kw_only=True)
class Written:
    """How a table is written."""

    header: tuple[str, ...] = ()
    """names of the columns of a text file without a head; its lines that begin with # are left out."""
    decimal: Literal[".", ","] = "."
    """what text writes for a decimal point."""
    time_format: str | None = None
    """how times are written as text, e.g. "%d/%m/%Y %H:%M:%S"; ISO 8601 needs none."""
    project: Literal["utm", "none"] | None = None
    """utm: x and y are degrees of longitude and latitude, to be metres; none: they are metres, whatever their names."""
    sort: bool = False
    """put each agent's rows in order of time, and leave out rows that repeat another."""
    join: bool = False
    """several files are of one recording; agents are called after the file, too, which is an agent if it names none."""
