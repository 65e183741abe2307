"""What the columns of a table are, and how episodes are made of its rows."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from ringfence.errors import UserError, unknown, whole_number
from ringfence.logs.io.table_options import Columns, EpisodeRules, Written
from ringfence.logs.schema import FIELDS as CARD_FIELDS
from ringfence.problem.constraints import Hazard, Separation
from ringfence.problem.entries import SPACE

LARGEST = 1e15  # number of a schema
LISTS = ("state", "action", "goal", "cost", "header")
PROJECTIONS = ("utm", "none")
LONGITUDE = {"lon", "lng", "long", "longitude"}  # words in names of columns
LATITUDE = {"lat", "latitude"}
DEGREES = {"deg", "degs", "degree", "degrees"}
TIMES = {  # s of what names of columns tell; None: nobody knows
    1e-3: "ms msec msecs millis millisecond milliseconds",
    1e-6: "us µs usec usecs micros microsecond microseconds",
    1e-9: "ns nsec nsecs nanos nanosecond nanoseconds",
    60.0: "min mins minute minutes",
    3600.0: "h hrs hour hours",
    None: "frame frames tick ticks step steps",
}
LENGTHS = {  # m
    1e-3: "mm millimeter millimeters millimetre millimetres",
    0.01: "cm centimeter centimeters centimetre centimetres",
    0.1: "dm",
    1e3: "km kilometer kilometers kilometre kilometres",
    0.3048: "ft foot feet",
    0.0254: "inch inches",
    0.9144: "yd yard yards",
    1609.344: "mi mile miles",
    None: "px pix pixel pixels",
}
SPEEDS = LENGTHS | {1 / 3.6: "kmh kph", 0.44704: "mph", 1852 / 3600: "kn kt kts knot knots"}  # m/s


@dataclass(frozen=True, kw_only=True)
class TableSchema(Columns, EpisodeRules, Written):
    """Columns of a table with a row per agent and time, in SI units. Checked when made; lists may be given as any
    iterable of names, and `cost` as one name.

    `time` is in units of `time_unit` s (1 by default), e.g. 0.04 of frames at 25 a second; dates are what they are.

    Columns of `state` named x, y, z are where an agent is, and vx, vy, vz how fast it moves in the same axes.
    Velocities that are not there are the differences of positions. `action` is an agent's command at that time, which
    it followed until its next row; without any, actions are its accelerations. `reward` and `cost` are what came since
    its row before. Without `reward`, it is the progress to the `goal` (columns of its x, y), in m, or 0. Without
    `cost`, it follows from `danger`, a `Separation`, or is 0. Several columns of costs are constraints of these names.
    `terminated` is a flag of the row with which an episode ended by itself, not by a time limit or the recording's end.
    The last row of an agent needs no command.

    Rows are put on steps of `dt` s (by default the table's own): states are interpolated, actions held. An agent that
    is silent for more than `gap` s (five steps) was away. Agents come and go: an episode is a time in which the same
    `team` of them is there (by default of the size with most rows). With `neighbours`=k it is the whole track of one
    agent, who sees the k nearest others within `sensing_radius` m; such agents are homogeneous, and a policy plays any
    number of them. Episodes have `min_episode_steps` to `max_episode_steps` steps. What moved faster than 100 m/s
    is refused; with `max_speed` m/s, rows that jumped faster than that are dropped, if they are few.

    `rename` has our names by the table's, for all that is named above. A table with columns for every agent says by
    `wide` how these are called: "{agent}_{column}" reads leader_x as x of `leader`, and `agent` is a name of our own.

    `header` names the columns of a text file without one, and `decimal` is what it writes for a point. `time_format`
    says how times are written as text, as `datetime.strptime` reads it. `scale` has factors by column, and
    `project="utm"` makes metres of x and y that are degrees of longitude and latitude. `sort` puts an agent's rows in
    the order of their times and leaves out those that repeat one. With `join`, several tables are of one recording,
    whose agents are called after the table, too; a table without the column `agent` is of one.
    """

    danger: Hazard | None = None
    rename: Mapping[str, str] = field(default_factory=dict)
    scale: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self):
        if isinstance(self.cost, str):
            object.__setattr__(self, "cost", (self.cost,))
        for name in LISTS:
            object.__setattr__(self, name, _names(name, getattr(self, name)))
        for rule in RULES:
            rule(self)

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> TableSchema:
        """The schema of options by name."""
        names = [each.name for each in fields(cls)]
        for name in options:
            if name in CARD_FIELDS and name not in names:
                raise UserError(f"{name} is said by the card, not by the table; give card={{'{name}': ...}}.")
            if name not in names:
                raise unknown("option of a table", name, names)
        for name in ("time", "agent", "state"):
            if name not in options:
                raise UserError(f"{name} of the table is not named; give {name}=, and time=, agent= and state= always.")
        return cls(**options)

    @property
    def position(self) -> tuple[str, ...]:
        return tuple(axis for axis in SPACE if axis in self.state)

    @property
    def velocity(self) -> tuple[str, ...]:
        return tuple(f"v{axis}" for axis in SPACE if f"v{axis}" in self.state)

    @property
    def axes(self) -> tuple[str, ...]:
        """Those that agents move along, by position or velocity."""
        return tuple(axis for axis in SPACE if axis in self.position or f"v{axis}" in self.velocity)

    @property
    def homogeneous(self) -> bool:
        """Whether an episode is of one agent among its neighbours."""
        return self.neighbours is not None

    @property
    def separation(self) -> Separation | None:
        """What a step costs by, where no column says it."""
        return self.danger if isinstance(self.danger, Separation) else None

    @property
    def columns(self) -> list[str]:
        """All that are read."""
        optional = [name for name in (self.episode, self.reward, self.terminated) if name]
        return [self.time, self.agent, *self.state, *self.action, *self.goal, *self.cost, *optional]

    @property
    def numbers(self) -> list[str]:
        """Those that a factor may be given of."""
        return [*self.state, *self.action, *self.goal, *self.cost, *([self.reward] if self.reward else [])]


def _names(field: str, given: Iterable[str] | None) -> tuple[str, ...]:
    if isinstance(given, str):
        raise UserError(f"{field}='{given}' is one word; give a list of columns.")
    if given is not None and not isinstance(given, Iterable):
        raise UserError(f"{field}={given!r:.60} is no list; give names of columns.")
    names = tuple(given) if given is not None else ()
    for name in names:
        _require_word(field, name)
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise UserError(f"{field} names the column '{twice[0]}' twice; name it once.")
    return names


def _require_word(field: str, name: Any) -> None:
    """Names of columns are words."""
    if not isinstance(name, str) or not name:
        raise UserError(f"{field}={name!r:.60} names no column; give its name, a word.")


# --- rules, in the order in which they are asked ---
def _words(schema: TableSchema) -> None:
    for option in ("time", "agent", "episode", "reward", "terminated", "wide", "time_format"):
        name = getattr(schema, option)
        if name is not None or option in ("time", "agent"):
            _require_word(option, name)
    if not isinstance(schema.rename, Mapping):
        raise UserError(f"rename={schema.rename!r:.60} is no dictionary; give our names by the table's.")
    for theirs, ours in schema.rename.items():
        _require_word("rename", theirs)
        _require_word("rename", ours)


def _episodes(schema: TableSchema) -> None:
    if schema.team is not None and schema.neighbours is not None:
        raise UserError("team and neighbours both say who an episode is of; give one of them.")
    for name in ("team", "neighbours", "max_episode_steps"):
        value = getattr(schema, name)
        if value is not None:
            whole_number(name, value, 1, 1000 if name == "neighbours" else 10**6)
    whole_number("min_episode_steps", schema.min_episode_steps, 1)
    most = schema.max_episode_steps
    fewest = schema.min_episode_steps
    if most is not None and most < fewest:
        raise UserError(
            f"max_episode_steps={most} is less than min_episode_steps={fewest}; give a smaller min_episode_steps, too."
        )
    for name in ("time_unit", "dt", "gap", "sensing_radius", "max_speed"):
        value = getattr(schema, name)
        if value is not None and not (isinstance(value, int | float) and 0 < value <= LARGEST):
            raise UserError(f"{name}={value!r:.60} must be a number above 0, and at most {LARGEST:g}.")


def _columns(schema: TableSchema) -> None:
    if not schema.state:
        raise UserError("state names no column; name those that say where an agent is and how it moves.")
    if schema.goal and len(schema.goal) != len(schema.position):
        raise UserError(
            f"goal names {len(schema.goal)} columns, the position has {len(schema.position)}; state must hold as many "
            "of x, y, z, under these names (rename)."
        )
    if (schema.homogeneous or schema.danger is not None) and not schema.position:
        raise UserError("state holds no x, y or z, which neighbours and distances follow from; rename these columns.")
    if schema.danger is not None and not isinstance(schema.danger, Separation):
        raise UserError(
            f"danger={type(schema.danger).__name__} is not read from a table; give a Separation or a cost column."
        )
    if schema.danger is not None and schema.cost:
        raise UserError("cost and danger both say what a step costs; give one of them.")
    if not schema.action and not schema.axes:
        raise UserError(
            "action names no column, and state holds no x or vx to tell accelerations by; name the actions."
        )


def _written(schema: TableSchema) -> None:
    ours = list(schema.rename.values())
    twice = [name for name in ours if ours.count(name) > 1]
    if twice:
        raise UserError(f"rename calls two columns '{twice[0]}'; give each a name of its own.")
    if schema.wide is not None and not (schema.wide.count("{agent}") == schema.wide.count("{column}") == 1):
        raise UserError(
            f"wide='{schema.wide}' must hold {{agent}} and {{column}} once; write it as '{{agent}}_{{column}}'."
        )
    if schema.decimal not in (".", ","):
        raise UserError(f"decimal={schema.decimal!r:.60} is no decimal point; give '.' or ','.")
    for name in ("sort", "join"):
        if not isinstance(getattr(schema, name), bool):
            raise UserError(f"{name}={getattr(schema, name)!r:.60} is no choice; give True or False.")
    if not isinstance(schema.scale, Mapping):
        raise UserError(f"scale={schema.scale!r:.60} is no dictionary; give factors by the names of columns.")
    for name, factor in schema.scale.items():
        if not (isinstance(factor, int | float) and math.isfinite(factor) and factor != 0):
            raise UserError(f"scale of {name}={factor!r:.60} must be a number other than 0.")


def _project(schema: TableSchema) -> None:
    if schema.project not in (None, *PROJECTIONS):
        raise unknown("projection", str(schema.project), PROJECTIONS)
    if schema.project == "utm" and schema.position[:2] != ("x", "y"):
        raise UserError("project='utm' makes metres of x and y, which state must hold; rename longitude=x latitude=y.")
    theirs = {ours: their for their, ours in schema.rename.items()}
    for ours in (*schema.position, *schema.goal):
        name = theirs.get(ours, ours)
        words = set(_words_of(name))
        if schema.project is None and words & (LONGITUDE | LATITUDE | DEGREES):
            raise UserError(
                f"'{name}' is in degrees by its name, and places are in metres; give project='utm' (--project utm) to "
                "make metres of longitude=x and latitude=y, or 'none' if it is in metres."
            )
        if schema.project == "utm" and words & {"x": LATITUDE, "y": LONGITUDE}.get(ours, set()):
            raise UserError(f"'{name}' is called {ours} for project='utm'; rename longitude=x latitude=y.")


def _units(schema: TableSchema) -> None:
    """Units that names tell, where nobody says a factor."""
    theirs = {ours: their for their, ours in schema.rename.items()}
    time = theirs.get(schema.time, schema.time)
    found = _unit_of(_words_of(time), TIMES)
    if found and schema.time_unit is None:
        raise UserError(
            f"'{time}' counts {found[0]} by its name, and times are in seconds; give as time_unit (--time-unit) "
            f"{found[1] or 'the seconds of one'}, or 1 if it is in seconds."
        )
    for ours in (*schema.position, *schema.velocity, *schema.goal):
        name = theirs.get(ours, ours)
        *before, last = _words_of(name)
        found = _unit_of(["".join([*before[-1:], last]), last, *before], SPEEDS if ours in schema.velocity else LENGTHS)
        is_place = found and found[0] == "px" and "x" not in before and ours[-1:] == "x"  # as py is
        if found and before and not is_place and ours not in schema.scale:
            raise UserError(
                f"'{name}' is in {found[0]} by its name, and {ours} is in SI units; give as scale of {ours} (--scale "
                f"{ours}=...) {found[1] or 'the metres of one'}, or 1 if it is in SI units."
            )
    for ours in set(schema.state) - {*schema.position, *schema.velocity, *schema.scale}:
        if DEGREES & {*_words_of(name := theirs.get(ours, ours))} - {*_words_of(ours)}:
            raise UserError(f"'{name}' is in degrees by its name; call it {ours}_deg, or give a scale of {ours}.")


def _words_of(name: str) -> list[str]:
    """Words of a column's name: t, ms of tMs, t_ms and t [ms]."""
    return re.findall(r"[a-zµ]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower()) or [""]


def _unit_of(words: list[str], units: Mapping[float | None, str]) -> tuple[str, str] | None:
    """The first word that is a unit, and its factor, of which there is none where nobody knows it."""
    known = {
        word: "" if factor is None else f"{factor:.6g}" for factor, named in units.items() for word in named.split()
    }
    return next(((word, known[word]) for word in words if word in known), None)


RULES: tuple[Callable[[TableSchema], None], ...] = (
    _words,
    _episodes,
    _columns,
    _written,
    _project,
    _units,
)
