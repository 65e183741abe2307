"""What the JSON files of this package hold, one schema each, checked where they are read.

msgspec checks while it decodes, so no file is believed before it has the right types: nesting, sizes of numbers, NaN
and missing fields are its business and not that of who reads the file. Fields that a schema does not name are kept.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict, TypeVar

import msgspec

from ringfence.errors import UserError
from ringfence.utils.files import regular

LARGEST = 2**27  # bytes of a JSON file; the largest that this package writes have some megabytes
T = TypeVar("T")

# What becomes part of a path: no separator, no control character, no leading dot or dash, of a file system's length.
_PART = r"\A(?![.\-])[^/\\\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]+\Z"
Name = Annotated[str, msgspec.Meta(pattern=_PART, max_length=120)]
Variant = Annotated[str, msgspec.Meta(pattern=_PART, max_length=200)]
Count = Annotated[int, msgspec.Meta(ge=0, le=10**12)]
Positive = Annotated[int, msgspec.Meta(ge=1, le=10**9)]
Few = Annotated[int, msgspec.Meta(ge=1, le=100_000)]  # agents, entries: what loops go over
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
Interval = tuple[float, float]
Scalar = bool | int | float | str | None
Bound = float | list[float | list[float]]  # of actions (problem/bounds.py)
Limits = Annotated[
    dict[Name, Annotated[float, msgspec.Meta(ge=0, le=1e12)]], msgspec.Meta(max_length=100)
]  # of constraints


class Hazard(TypedDict):
    kind: str


class Spec(TypedDict, total=False):
    task: Name
    n_agents: Few
    action_dim: Few
    feature_names: Annotated[list[str], msgspec.Meta(min_length=1)]
    action_low: Bound
    action_high: Bound
    episode_length: Positive
    homogeneous: bool
    action_sizes: list[Positive] | None


class Map(TypedDict):
    """features.to_dict"""

    view: str
    names: list[str]
    source: str
    plus: list[list[int]]
    minus: list[list[int]]
    joint: bool
    follows: NotRequired[list[int]]
    dt: NotRequired[float | None]
    order: NotRequired[list[list[int]]]
    turns: NotRequired[list[tuple[int, float, float]]]
    mirrored: NotRequired[list[tuple[list[int], int]]]


class Data(TypedDict, total=False):
    """What a run or a World says of its data; whatever else a card holds is there, too."""

    constraints: Limits | None
    team: Few | None
    cost_limit: Annotated[float, msgspec.Meta(ge=0)] | None
    action_low: Bound
    action_high: Bound
    agents: list[str] | None
    observation_names: list[str] | None
    state_names: list[str] | None
    observation_origins: list[float] | None
    state_origins: list[float] | None
    sensing_radius: Annotated[float, msgspec.Meta(gt=0)] | None


class Config(TypedDict):
    """config.json of a run."""

    algorithm: str
    preset: Name
    config: dict[str, Any]  # typed by the algorithm's own Config (runs.build_config)
    task: Name
    hazard: Hazard
    seed: Annotated[int, msgspec.Meta(ge=0, lt=2**31)]
    data: Data
    revision: NotRequired[int]
    spec: NotRequired[Spec]
    feature_map: NotRequired[Map | None]
    widths: NotRequired[tuple[int | None, int | None] | None]
    returns: NotRequired[tuple[float, float] | None]
    world: NotRequired[dict[str, Scalar] | None]
    team: NotRequired[Few]


class Card(TypedDict):
    """What a World's card cannot do without."""

    data: Data


class World(TypedDict):
    """What a World's file says of it."""

    map: Map
    spec: Spec
    card: Card
    digest: NotRequired[str]  # of all else, arrays included


class PerEpisode(TypedDict, total=False):
    cost: list[float]
    unsafe_start: list[bool]
    steps: list[int]
    terminated: list[bool]


class Constants(TypedDict):
    return_min: float
    return_max: float
    cost_limit: float
    cost_offset: float


class Constraint(TypedDict):
    """What a named one cost per episode."""

    cost_mean: float
    violation_rate: Share
    cost_interval: NotRequired[Interval]
    violation_upper: NotRequired[Share]
    limit: NotRequired[float]
    limit_satisfied_rate: NotRequired[Share]


class Result(TypedDict, total=False):
    """A summary of episodes: an evaluation in results.json, or a reference row."""

    episodes: Positive
    return_mean: float
    return_std: float
    return_norm: float
    return_interval: Interval
    cost_mean: float
    cost_interval: Interval
    cost_norm: float
    cost_cvar10: float
    cost_rate: float
    violation_rate: Share
    violation_interval: Interval
    violation_upper: Share
    agent_violation_rate: Share
    unsafe_starts: Count
    cut_episodes: Count  # that one agent left before the others
    skipped_episodes: Count
    cost_safe_start: float
    cost_safe_start_interval: Interval
    violation_upper_safe_start: Share
    steps_mean: float
    termination_rate: Share
    constants: Constants
    per_episode: PerEpisode
    protocol: int
    task: str
    split: str
    seed: int
    step: int
    algorithm: str
    variant: Variant
    spec: str  # PolicySpec.name
    command: list[str]  # of `ringfence`, without the run folder
    planner: str
    options: dict[str, Scalar]
    guard: str
    barrier: str
    execution: str
    agents: Few
    guard_options: dict[str, Scalar]
    world_settings: dict[str, Scalar]
    verdict: str  # of the World that the guard asks
    infeasible_rate: float
    ood_rate: float
    eval_seconds: float
    train_seconds: float
    plan_ms_p50: float | None
    plan_ms_p99: float | None
    parameters: int | None
    simulator: str  # of anybody's, that `play` played in
    data: dict[str, Any]
    constraints: dict[str, Constraint]


Results = dict[Variant, Result]
References = dict[str, Result]


class Outcomes(TypedDict):
    """logs.json of a run: a number of each episode that it was trained on."""

    returns: list[float]
    costs: list[float]
    steps: list[Count]
    terminated: list[bool]
    constraints: dict[str, list[float]]  # costs of each that is named


class Status(TypedDict, total=False):
    """status.json of a cell."""

    state: str
    attempts: Count
    id: str
    train_seconds: float
    eval_seconds: float
    error: str
    traceback: str
    adopted: str


class Bench(TypedDict, total=False):
    """bench.json of a results folder."""

    format: int
    protocol: int
    suite: str
    episodes: Positive
    split: str


class Environment(TypedDict, total=False):
    """env.json of a run."""

    ringfence: str
    python: str
    packages: dict[str, str]
    devices: list[str]
    processor: str
    cores: int | None
    system: str
    git: str | None


class Event(TypedDict):
    """A record of a controller's log."""

    t: Annotated[float, msgspec.Meta(ge=0, lt=253_402_300_800)]  # s since 1970; calendars end with the year 9999


class Corrected(TypedDict):
    """An agent whose action is another than it requested."""

    agent: Count
    requested: list[float | None]
    constraint: str
    thing: str
    row: Count
    score: float | None


class Acted(Event):
    """A record of an action."""

    ms: float
    executed: list[list[float | None]]
    corrected: NotRequired[list[Corrected]]


class Refused(Event):
    """A record of a refusal."""

    why: str


RECORDS: dict[str, Any] = {"step": Acted, "refused": Refused}  # by kind; of others only the time is read


class Row(TypedDict):
    """A line of metrics.jsonl."""

    step: int
    seconds: float


def decode(raw: bytes | str, kind: Any) -> Any:
    """JSON of `kind`, with the fields that it does not name; ValueError says what is wrong and where."""
    try:
        value = msgspec.json.decode(raw)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    except (msgspec.MsgspecError, UnicodeError) as error:
        raise ValueError(str(error)) from None
    check(value, kind)  # what the schema does not name stays
    return value


def check(value: Any, kind: Any) -> Any:
    """A value of Python's as the kind; ValueError where it is not of it."""
    try:
        return msgspec.convert(value, kind)
    except (msgspec.MsgspecError, UnicodeError) as error:
        raise ValueError(str(error)) from None


def content(path: Path, largest: int = LARGEST) -> bytes:
    """Of a file that is no larger; ValueError says what it is else."""
    size = regular(path).stat().st_size
    if size > largest:
        raise ValueError(f"it is larger than {largest / 2**20:.0f} MiB")
    return path.read_bytes()


def read(path: Path, kind: type[T], problem: str) -> T:
    """What a JSON file holds, as `kind`; whatever else is there is `problem`, a sentence's end with the remedy."""
    try:
        return decode(content(path), kind)
    except (OSError, ValueError) as error:
        cause = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise UserError(f"'{path.parent}' {problem} ({path.name}: {cause}).") from None
