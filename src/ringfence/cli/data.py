"""`ringfence data`: stores made, imported, inspected."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.markup import escape

from ringfence.cli.shared import console
from ringfence.errors import UserError, plain
from ringfence.logs.io.table_options import Columns, EpisodeRules, Written
from ringfence.utils.files import writable
from ringfence.utils.text import terminal

out = console()
Positional = tyro.conf.Positional
Robot = Literal["halfcheetah_2x3", "ant_2x4", "ant_4x2"]
Out = Annotated[Path, tyro.conf.arg(name="out")]


@dataclass(frozen=True)
class Episodes(EpisodeRules):
    """How rows of agents and times become episodes."""

    separation: float | None = None
    """m between two agents' centres below which a step costs 1, where nothing else says what it costs."""

    def options(self) -> dict[str, Any]:
        """Fields of a `TableSchema`."""
        from ringfence.problem.constraints import Separation

        given = dataclasses.asdict(self)
        radius = given.pop("separation")
        return {**given, "danger": None if radius is None else Separation(radius, radius / 4)}


AS_THEY_ARE = Episodes()
HowEpisodes = tyro.conf.OmitArgPrefixes[Episodes]
UNNAMED = Columns()
Named = tyro.conf.OmitArgPrefixes[Columns]
AS_USUAL = Written()
HowWritten = tyro.conf.OmitArgPrefixes[Written]


@dataclass(frozen=True)
class ActionBounds:
    """How far actions go."""

    action_low: list[float] = field(default_factory=list)
    """least of each entry of an action, or one of all; by default as far as the largest logged command, and 0 where
    none is negative."""
    action_high: list[float] = field(default_factory=list)
    """likewise the largest."""

    def facts(self) -> dict[str, Any]:
        """What a card says of them: one number of all entries, or one of each."""
        given = {name: getattr(self, name) for name in ("action_low", "action_high")}
        return {name: ends[0] if len(ends) == 1 else ends for name, ends in given.items() if ends}


AS_LOGGED = ActionBounds()
HowBounded = tyro.conf.OmitArgPrefixes[ActionBounds]


def make(
    task: Positional[str],
    size: int | None = None,
    seed: int = 0,
    out_file: Annotated[Path | None, tyro.conf.arg(name="out")] = None,
    fresh: bool = False,
) -> None:
    """Regenerate a task's data set (cached).

    Args:
        task: its name, as `ringfence tasks` lists it.
        size: transitions; the full data set by default.
        seed: of the collection.
        out_file: write here instead of the cache.
        fresh: simulate again, whatever the cache holds.
    """
    from ringfence.datasets import registry
    from ringfence.datasets.make import make

    store, path = make(registry.get(task), size, seed, out_file, fresh)
    out.print(f"{store.episodes:,} episodes, {store.steps:,} steps: {path}", soft_wrap=True, markup=False)


def import_table(
    files: Positional[list[Path]],
    out_file: Out,
    columns: Named = UNNAMED,
    bounds: HowBounded = AS_LOGGED,
    limits: list[float] = [],  # noqa: B006 (tyro reads it, nobody writes it)
    rename: list[str] = [],  # noqa: B006
    scale: list[str] = [],  # noqa: B006
    layout: Literal["highd", "interaction", "syndrone", "sumo", "obsmat"] | None = None,
    split: float | None = None,
    episodes: HowEpisodes = AS_THEY_ARE,
    written: HowWritten = AS_USUAL,
    task: str | None = None,
) -> None:
    """Import a table with a row per agent and time; CSV and Parquet need the extra `ringfence[tables]`.

    Args:
        files: fleet.csv, fleet.parquet, fleet.jsonl (JSON lines), SUMO's fcd.xml, an obsmat.txt, or with --header any
            text; several are recordings, each with episodes of its own.
        out_file: the store to write.
        columns: what its columns are.
        bounds: how far actions go.
        limits: cost of each constraint that an episode may have, in the order of --cost; 0 by default.
        rename: what columns are called in the file and here, e.g. position_x=x position_y=y.
        scale: factors of columns, e.g. x=0.01 y=0.01 of cm, vx=0.514444 of knots.
        layout: names of columns of a published format, instead of options of columns.
        split: share of the time to learn by, e.g. 0.7; the rest is written beside it, as fleet-rest.h5, to judge by.
        episodes: how rows become episodes.
        written: how files are written.
        task: a name for the data; that of the store's file by default.
    """
    from ringfence.logs.large import import_large, is_large
    from ringfence.logs.store import EpisodeStore

    if not files:
        raise UserError("import-table got no file; name one, or several recordings.")
    named = files[0].name if len(files) == 1 else f"{files[0].name} and {len(files) - 1} more"
    kept = writable(out_file)
    rest = None if split is None else writable(kept.with_name(f"{kept.stem}-rest{kept.suffix}"))
    facts = {"task": task or kept.stem, "provenance": f"table {named}", **_limits_of(columns.cost, limits)}
    how = episodes.options() | dataclasses.asdict(written) | {"scale": _factors(scale)}
    options: dict[str, Any] = {**how, "cost": columns.cost, "card": facts | bounds.facts()}
    if layout is None:
        options |= {**dataclasses.asdict(columns), "rename": _pairs(rename, "--rename", "THEIRS=OURS", "position_x=x")}
    elif dataclasses.replace(columns, cost=()) != UNNAMED or rename or written.header:
        raise UserError(f"--layout {layout} says which columns are what, in which unit; leave these options out.")
    else:
        options["layout"] = layout
    if split is not None and rest is not None:
        learned, judged = EpisodeStore.split_table(files, split, **options)
        imported(learned, kept)
        return imported(judged, rest)
    if is_large(files, options):
        return noted(*import_large(files, kept, **options), kept)
    made = EpisodeStore.from_table if layout is None else EpisodeStore.from_layout
    imported(made(files, **options), kept)


def _pairs(given: list[str], option: str, form: str, example: str) -> dict[str, str]:
    """What is given after an = by what is before it."""
    pairs = {}
    for pair in given:
        name, equals, value = pair.rpartition("=")
        if not (name and equals and value) or name in pairs:
            raise UserError(f"{option} {pair} must be {form}, each name once, such as {example}.")
        pairs[name] = value
    return pairs


def _factors(scale: list[str]) -> dict[str, float]:
    """Factors by our names of columns."""
    factors = {}
    for name, text in _pairs(scale, "--scale", "COLUMN=FACTOR", "x=0.01").items():
        try:
            factors[name] = float(text)
        except ValueError:
            raise UserError(f"--scale {name}={text} gives no number; write it as x=0.01.") from None
    return factors


def _limits_of(cost: Sequence[str], limits: list[float]) -> dict[str, Any]:
    """What a card says of the limits of these costs: of each by its name, where there are several."""
    if limits and len(limits) != len(cost):
        raise UserError(f"--limits gives {len(limits)} numbers for {len(cost)} columns of costs; give one for each.")
    if len(cost) > 1:
        return {"constraints": dict(zip(cost, limits))}
    return {"cost_limit": limits[0]} if limits else {}


def import_bag(
    file: Positional[Path],
    agents: str,
    out_file: Out,
    odom: str = "odom",
    cmd: str | None = None,
    joints: str | None = None,
    cost: str | None = None,
    episodes: HowEpisodes = AS_THEY_ARE,
    stamps: bool = True,
    twist: Literal["child", "world"] = "child",
    bounds: HowBounded = AS_LOGGED,
    task: str | None = None,
) -> None:
    """Import a ROS 1 or ROS 2 bag or an MCAP file; needs the extra `ringfence[ros]`.

    Args:
        file: run1.bag, run1.mcap or a ROS 2 bag's folder.
        agents: prefix of the agents' topics, {i} standing for any number or word, e.g. /robot_{i}.
        out_file: the store to write.
        odom: topic of poses, below the prefix.
        cmd: topic of commands (Twist or Ackermann), below the prefix; cmd_vel by default, and where nobody has it,
            accelerations.
        joints: topic of joint states, below the prefix.
        cost: topic of danger, of each agent below the prefix, or of the team.
        episodes: how rows become episodes.
        stamps: take the times in headers; --no-stamps takes those of recording.
        twist: frame of the odometry's velocities, child (ROS's rule) or world.
        bounds: how far actions go.
        task: a name for the data; that of the store's file by default.
    """
    from ringfence.logs.io.rosbag import read_bag
    from ringfence.logs.store import EpisodeStore

    kept = writable(out_file)
    bag = read_bag(file, agents, odom=odom, cmd=cmd, joints=joints, cost=cost, stamps=stamps, twist=twist)
    store = EpisodeStore.from_table(
        bag.columns,
        time="time",
        agent="agent",
        state=bag.state,
        action=bag.action,
        cost="cost" if "cost" in bag.columns else None,
        notes=bag.notes,
        card={"task": task or kept.stem, "provenance": f"bag {file.name}"} | bounds.facts(),
        **episodes.options(),
    )
    imported(store, kept)


def import_lerobot(
    folder: Positional[Path],
    out_file: Out,
    arms: list[str] = [],  # noqa: B006
    state: list[str] = ["observation.state"],  # noqa: B006
    min_episode_steps: int = 5,
    max_episode_steps: int | None = None,
    bounds: HowBounded = AS_LOGGED,
    task: str | None = None,
) -> None:
    """Import a LeRobot data set of version 2 or 3; needs the extra `ringfence[tables]`.

    Args:
        folder: the one that holds meta/info.json and data.
        out_file: the store to write.
        arms: prefixes of entries' names, an agent each, e.g. left right; these two by default, if every action begins
            with one of them.
        state: columns of what an arm knows of itself, e.g. observation.state observation.velocity.
        min_episode_steps: steps of an episode, at least.
        max_episode_steps: steps of an episode, at most; longer ones are cut.
        bounds: how far actions go.
        task: a name for the data; that of the store's file by default.
    """
    from ringfence.logs.io.lerobot import read_lerobot
    from ringfence.logs.store import EpisodeStore

    kept = writable(out_file)
    read = read_lerobot(folder, arms, state)
    store = EpisodeStore.from_table(
        read.columns,
        time="time",
        agent="agent",
        episode="episode",
        state=read.state,
        action=read.action,
        reward=read.reward,
        dt=read.dt,
        min_episode_steps=min_episode_steps,
        max_episode_steps=max_episode_steps,
        notes=read.notes,
        card={"task": task or kept.stem, "provenance": f"LeRobot {folder.resolve().name}"} | bounds.facts(),
    )
    imported(store, kept)


def import_omar(
    directories: Positional[list[Path]],
    out_file: Out,
    radius: float | None = None,
    task: str | None = None,
) -> None:
    """Import OMAR's seed directories (obs_i.npy, acs_i.npy, rews_i.npy, next_obs_i.npy, dones_i.npy), several as one.

    Args:
        directories: e.g. simple_spread/expert/seed_0_data; those of several seeds make a pooled set.
        out_file: the store to write.
        radius: m between two agents' centres below which a step costs 1; 0.30 by default, and another one needs --task.
        task: a name for the data; that of the tier in the directory's path by default.
    """
    from ringfence.datasets.importers import import_omar
    from ringfence.problem.constraints import Separation

    if radius is not None and task is None:
        raise UserError(f"--radius {radius:g} is another danger than the tiers'; give the data a name with --task.")
    hazard = None if radius is None else Separation(radius, radius / 4)
    file = writable(out_file)
    imported(import_omar(directories[0] if len(directories) == 1 else directories, hazard, task), file)


def import_ogmarl(
    vault: Positional[Path],
    task: Robot,
    out_file: Out,
    speed_limit: float | None = None,
    quantile: bool = False,
    tier: str | None = None,
) -> None:
    """Import a robot's Vault of OG-MARL's; needs the extra `ringfence[vault]`.

    Args:
        vault: e.g. 2halfcheetah.vlt/Good.
        task: whose robot it is.
        out_file: the store to write.
        speed_limit: m/s above which a step costs 1; safety-gymnasium's by default.
        quantile: take the limit of the tier's `-quantile` task.
        tier: good, medium, poor or a word of your own; the folder's name by default, if it is a tier's.
    """
    from ringfence.datasets.importers import import_vault

    file = writable(out_file)
    imported(import_vault(vault, task, _limit(speed_limit, quantile), tier), file)


def import_madiff(
    directory: Positional[Path],
    task: Robot,
    out_file: Out,
    speed_limit: float | None = None,
    quantile: bool = False,
    tier: str | None = None,
) -> None:
    """Import a robot's arrays of MADIFF's release (obs.npy, actions.npy, rewards.npy, path_lengths.npy).

    Args:
        directory: the one that holds the arrays.
        task: whose robot it is.
        out_file: the store to write.
        speed_limit: m/s above which a step costs 1; safety-gymnasium's by default.
        quantile: take the limit of the tier's `-quantile` task.
        tier: good, medium, poor or a word of your own; the folder's name by default, if it is a tier's.
    """
    from ringfence.datasets.importers import import_madiff

    file = writable(out_file)
    imported(import_madiff(directory, task, _limit(speed_limit, quantile), tier), file)


def import_hdf5(
    file: Positional[str],
    out_file: Out,
    task: str | None = None,
    agents: str | None = None,
    cost_limit: float | None = None,
    action_low: tuple[float, ...] | None = None,
    action_high: tuple[float, ...] | None = None,
) -> None:
    """Import an HDF5 file in DSRL's, D4RL's or Minari's layout, as the logs of one agent or of several.

    Args:
        file: the HDF5 file, a Minari data set's folder, or the name of one on this machine, e.g. D4RL/door/human-v2.
        out_file: the store to write.
        task: a name for the data; that of the file or the data set by default.
        agents: who sees and moves which columns, as JSON or a JSON file: {"a": {"observation": [0, 1], "action": [0]}}.
        cost_limit: the cost per episode that reports call safe.
        action_low: bound of all action entries, or one of each; Minari's action space tells it by default, else -1.
        action_high: likewise, else 1.
    """
    from ringfence.datasets.importers import import_hdf5

    target = _another(out_file, file, "its own import")
    bounds = {"action_low": action_low, "action_high": action_high}
    imported(import_hdf5(file, task=task, agents=agents, cost_limit=cost_limit, **bounds), target)


def _another(out_file: Path, file: str | Path, what: str) -> Path:
    """Where to write what is made of a file: another one."""
    target = writable(out_file)
    if target.exists() and Path(file).exists() and target.samefile(file):
        raise UserError(f"'{file}' would be overwritten by {what}; give another file with --out.")
    return target


def _limit(speed_limit: float | None, quantile: bool):
    if quantile and speed_limit is not None:
        raise UserError("--quantile and --speed-limit both set the limit; give one of them.")
    return "quantile" if quantile else speed_limit


def imported(store, file: Path) -> None:
    """Keep what was imported, and say what was noted."""
    from ringfence.datasets.audit import odd_costs
    from ringfence.logs.resolution import coarse

    card = store.card.updated(warnings=[*store.card.warnings, *odd_costs(store), *coarse(store)])
    store.save(file)
    noted(card, store.episodes, store.steps, file)


def noted(card, episodes: int, steps: int, file: Path) -> None:
    """Say what was imported, and what was noted."""
    each = f" of {card.dt:g} s" if card.dt is not None else ""
    out.print(f"{episodes:,} episodes, {steps:,} steps{each}: {file}", soft_wrap=True, markup=False)
    for note in card.warnings:
        out.print(f"[yellow]note[/] {escape(plain(note))}", soft_wrap=True)


def undelay(file: Positional[Path], out_file: Out, delay: int) -> None:
    """Make logs of a machine whose commands take effect late as they would be if they did at once.

    Each step gets the command that was sent `delay` steps before; the first steps of each episode are left out. A
    guard by a World of such logs decides for so much later by itself. `data info` says what delay the logs tell.

    Args:
        file: a store.
        out_file: the store to write.
        delay: steps after which a command takes effect.
    """
    from ringfence.logs.late import undelay
    from ringfence.logs.store import EpisodeStore

    target = _another(out_file, file, "its undelayed logs")
    imported(undelay(EpisodeStore.load(file), delay), target)


def info(file: Positional[Path]) -> None:
    """The card of a store: sizes, returns, cost, share of episodes that start unsafe, warnings."""
    from ringfence.datasets.audit import audit
    from ringfence.logs.store import LEARNED, EpisodeStore

    report = audit(EpisodeStore.load(file, LEARNED))
    for name, value in report.facts.items():
        out.print(terminal(f"{name:24} {value}"), soft_wrap=True)
    for note in report.notes:
        out.print(f"[yellow]note[/] {escape(plain(note))}", soft_wrap=True)
    for warning in report.warnings:
        out.print(f"[yellow]warning[/] {escape(plain(warning))}", soft_wrap=True)


COMMANDS = {
    "make": make,
    "import-table": import_table,
    "import-bag": import_bag,
    "import-lerobot": import_lerobot,
    "import-omar": import_omar,
    "import-ogmarl": import_ogmarl,
    "import-madiff": import_madiff,
    "import-hdf5": import_hdf5,
    "undelay": undelay,
    "info": info,
}
