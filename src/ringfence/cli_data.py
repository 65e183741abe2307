"""`ringfence data`: stores made, imported, inspected."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from ringfence.errors import UserError
from ringfence.files import writable

Positional = tyro.conf.Positional
Out = Annotated[Path, tyro.conf.arg(name="out")]


def import_table(
    file: Positional[Path],
    out_file: Out,
    time: str = "time",
    agent: str = "agent",
    state: list[str] = [],  # noqa: B006 (tyro reads it, nobody writes it)
    episode: str | None = None,
    action: list[str] = [],  # noqa: B006
    reward: str | None = None,
    cost: str | None = None,
    goal: list[str] = [],  # noqa: B006
    layout: Literal["highd", "interaction"] | None = None,
    separation: float | None = None,
    dt: float | None = None,
    gap: float | None = None,
    team: int | None = None,
    neighbours: int | None = None,
    sight: float | None = None,
    shortest: int = 5,
    longest: int | None = None,
    fastest: float = 100.0,
    task: str | None = None,
) -> None:
    """Import a CSV or Parquet file with a row per agent and time; needs the extra `ringfence[tables]`.

    Args:
        file: fleet.csv or fleet.parquet.
        out_file: the store to write.
        time: column of times, s (or of dates).
        agent: column that tells agents apart.
        state: columns of where an agent is (x y z), how it moves (vx vy vz) and what else it knows of itself, SI units.
        episode: column that tells recordings apart.
        action: columns of what it was told to do until its next row; accelerations by default.
        reward: column of what it earned since its row before; progress to the goal by default, or nothing.
        cost: column of danger since its row before, 0 or above.
        goal: columns of where it is to go, as many as its position has.
        layout: names of columns of a published format, instead of the options above.
        separation: m between two agents' centres below which a step costs 1, where no column tells.
        dt: s, of the store's steps; the table's own by default.
        gap: s without a row, after which an agent was away; five steps by default.
        team: agents of an episode; by default as many as most rows have.
        neighbours: episodes of one agent each, who sees so many others; one policy for any number of them.
        sight: m, how far such an agent sees.
        shortest: steps of an episode, at least.
        longest: steps of an episode, at most; longer ones are cut.
        fastest: m/s that nothing there can do.
        task: a name for the data; the file's by default.
    """
    from ringfence.data.tables import from_layout, from_table
    from ringfence.hazards import Separation

    out = writable(out_file)
    told = {
        "danger": None if separation is None else Separation(separation, separation / 4),
        **dict(dt=dt, gap=gap, team=team, neighbours=neighbours, sight=sight, shortest=shortest, longest=longest),
        "fastest": fastest,
        "cost": cost,
        "card": {"task": task or file.stem, "provenance": f"table {file.name}"},
    }
    if layout is not None:
        if state or action or reward or goal or episode:
            raise UserError(f"--layout {layout} says which columns are what; leave the names of columns out.")
        return imported(from_layout(file, layout, **told), out)
    columns = dict(state=state, action=action, reward=reward, goal=goal, episode=episode)
    imported(from_table(file, time=time, agent=agent, **columns, **told), out)


def import_bag(
    file: Positional[Path],
    agents: str,
    out_file: Out,
    odom: str = "odom",
    cmd: str = "cmd_vel",
    joints: str | None = None,
    cost: str | None = None,
    separation: float | None = None,
    dt: float | None = None,
    gap: float | None = None,
    team: int | None = None,
    neighbours: int | None = None,
    sight: float | None = None,
    shortest: int = 5,
    longest: int | None = None,
    stamps: bool = True,
    twist: Literal["child", "world"] = "child",
    task: str | None = None,
) -> None:
    """Import a ROS 1 or ROS 2 bag or an MCAP file; needs the extra `ringfence[ros]`.

    Args:
        file: run1.bag, run1.mcap or a ROS 2 bag's folder.
        agents: prefix of the agents' topics, {i} standing for any number or word, e.g. /robot_{i}.
        out_file: the store to write.
        odom: topic of poses, below the prefix.
        cmd: topic of commands, below the prefix.
        joints: topic of joint states, below the prefix.
        cost: topic of danger, of each agent below the prefix, or of the team.
        separation: m between two agents' centres below which a step costs 1, where no topic tells.
        dt: s, of the store's steps; the odometry's own by default.
        gap: s without odometry, after which an agent was away; five steps by default.
        team: agents of an episode; by default as many as most rows have.
        neighbours: episodes of one agent each, who sees so many others; one policy for any number of them.
        sight: m, how far such an agent sees.
        shortest: steps of an episode, at least.
        longest: steps of an episode, at most; longer ones are cut.
        stamps: take the times in headers; --no-stamps takes those of recording.
        twist: frame of the odometry's velocities, child (ROS's rule) or world.
        task: a name for the data; the file's by default.
    """
    from ringfence.data.bags import read_bag
    from ringfence.data.tables import from_table
    from ringfence.hazards import Separation

    out = writable(out_file)
    bag = read_bag(file, agents, odom=odom, cmd=cmd, joints=joints, cost=cost, stamps=stamps, twist=twist)
    store = from_table(
        bag.columns,
        time="time",
        agent="agent",
        state=bag.state,
        action=bag.action,
        cost="cost" if "cost" in bag.columns else None,
        danger=None if separation is None else Separation(separation, separation / 4),
        **dict(dt=dt, gap=gap, team=team, neighbours=neighbours, sight=sight, shortest=shortest, longest=longest),
        notes=bag.notes,
        card={"task": task or file.stem, "provenance": f"bag {file.name}"},
    )
    imported(store, out)


def imported(store, file: Path) -> None:
    """Keep what was imported, and say what was noted."""
    from rich.console import Console
    from rich.markup import escape

    out = Console(highlight=False)
    out.print(f"{store.episodes:,} episodes, {store.steps:,} steps: {store.save(file)}", soft_wrap=True, markup=False)
    for note in store.card["warnings"]:
        out.print(f"[yellow]note[/] {escape(note)}", soft_wrap=True)


COMMANDS = {"import-table": import_table, "import-bag": import_bag}
