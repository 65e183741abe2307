"""What a store must be: the rules of its card and of its arrays, each refused by name with the remedy."""

from __future__ import annotations

import copy
import difflib
import json
import math
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import msgspec
import numpy as np

from ringfence.errors import StoreError, UserError
from ringfence.problem import constraints
from ringfence.problem.bounds import SHOWN, Bounds
from ringfence.problem.bounds import stored as stored_bound
from ringfence.problem.origins import FIELDS as ORIGINS
from ringfence.problem.origins import Origins
from ringfence.types import as_tuples
from ringfence.utils import schemas

ARRAYS = ("observations", "actions", "rewards", "costs", "terminated", "truncated", "episode_ends")
LARGEST = 1e15  # entry of an array: its square, and sums of that, are still numbers of 32 bits
OPTIONAL = ("state", "speed", "constraints")
ROWS = ("observations", "state")  # arrays with one row more than steps in every episode
LIKELY = 0.85  # similarity of two names, from which one is taken for the other mistyped
WORDS = ("simulator", "provenance", "content")
# What a card says of where its steps come from; the rest describes them, and later versions describe more.
ORIGIN = ("task", "provenance", "simulator", "integrator", "reward", "seed", "transitions", "hazard", "content")
ORIGIN += ORIGINS
LISTS_OF_NAMES = ("observation_names", "state_names")
ALWAYS = (
    "task",
    "simulator",
    "provenance",
    "action_low",
    "action_high",
    "observation_names",
    "state_names",
    "hazard",
)  # fields of a card that its JSON always has


class StoreCard(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """What a store says of itself: fields that are read by name, and in `extra` whatever else its JSON holds.

    `complete_card` checks a card; a store does so when it is made. `to_dict` gives its JSON, with the fields that were
    given and in their order, so that a card that is read and written again stays the same.
    """

    task: str = "custom"
    simulator: str | None = None  # what the data was recorded in, with its version
    provenance: str = "user data"
    action_low: float | list = -1.0  # of all entries, of each, or of each agent's entries (problem/bounds.py)
    action_high: float | list = 1.0
    observation_names: list[str] | None = None
    state_names: list[str] | None = None
    observation_origins: list[float] | None = None  # what was taken from each entry, e.g. of coordinates of a map
    state_origins: list[float] | None = None
    hazard: dict[str, Any] = msgspec.field(default_factory=lambda: {"kind": "CostColumn"})
    dt: float | None = None  # s, of a step
    cost_limit: float | None = None  # of the team, per episode
    constraints: dict[str, float] | None = None  # limit per episode, by name
    homogeneous: bool = False
    agents: list[str] | None = None  # their names
    action_sizes: list[int] | None = None  # entries of each agent's action
    team: int | None = None  # agents of the team whose logs were split into those of single ones
    content: str | None = None  # digest of the arrays that these were made of
    sensing_radius: float | None = None  # m
    action_delay: int = 0  # steps that commands took to take effect, of logs without that now (logs/late.py)
    warnings: list[str] = []
    extra: dict[str, Any] = {}
    written: tuple[str, ...] = ()  # names in the JSON, in order

    def to_dict(self) -> dict[str, Any]:
        """Its JSON: what was given, and what differs from the defaults."""
        plain = StoreCard()
        own = {name: getattr(self, name) for name in FIELDS}
        differ = [name for name in FIELDS if name in ALWAYS or own[name] != getattr(plain, name)]
        values = {**self.extra, **own}
        names = dict.fromkeys([*self.written, *differ, *self.extra])
        return {name: copy.deepcopy(values[name]) for name in names}

    @property
    def origins(self) -> Origins:
        """What was taken from entries that are far from 0."""
        return Origins.of({name: getattr(self, name) for name in ORIGINS})

    @property
    def bounds(self) -> Bounds:
        """Of actions."""
        return Bounds(as_tuples(self.action_low), as_tuples(self.action_high))

    def updated(self, **fields: Any) -> StoreCard:
        """The card with other fields, of any name."""
        return complete_card({**self.to_dict(), **fields})

    def __eq__(self, other: object) -> bool:
        if isinstance(other, StoreCard):
            return self.to_dict() == other.to_dict()
        return NotImplemented


FIELDS = tuple(name for name in StoreCard.__struct_fields__ if name not in ("extra", "written"))
GivenCard = StoreCard | Mapping[str, Any]


class Arrays(Protocol):
    """What a store shows to its rules; the axes are those of `store.py`."""

    @property
    def observations(self) -> np.ndarray: ...
    @property
    def actions(self) -> np.ndarray: ...
    @property
    def rewards(self) -> np.ndarray: ...
    @property
    def costs(self) -> np.ndarray: ...
    @property
    def terminated(self) -> np.ndarray: ...
    @property
    def truncated(self) -> np.ndarray: ...
    @property
    def episode_ends(self) -> np.ndarray: ...
    @property
    def state(self) -> np.ndarray | None: ...
    @property
    def speed(self) -> np.ndarray | None: ...
    @property
    def constraints(self) -> np.ndarray | None: ...
    @property
    def card(self) -> StoreCard: ...
    @property
    def limits(self) -> dict[str, float]: ...


def complete_card(given: GivenCard) -> StoreCard:
    """The card of these fields, checked; unknown fields are kept, for provenance of any kind."""
    fields = given.to_dict() if isinstance(given, StoreCard) else given
    if not isinstance(fields, dict):
        raise StoreError(f"The card is a {type(fields).__name__}; it must be a dictionary of fields.")
    defaults = StoreCard()
    card: dict[str, Any] = {**{name: getattr(defaults, name) for name in ALWAYS}, **fields}
    for rule in CARD_RULES:
        rule(card)
    try:
        # NumPy's arrays and numbers become plain
        values: dict[str, Any] = json.loads(json.dumps(card, default=lambda x: x.tolist()))
    except (AttributeError, TypeError, ValueError) as error:
        raise StoreError(f"The card cannot be kept as JSON ({error}); use words, numbers, lists and dicts.") from None
    known = {name: value for name, value in values.items() if name in FIELDS}
    known["warnings"] = known.get("warnings") or []
    extra = {name: value for name, value in values.items() if name not in FIELDS}
    return StoreCard(**known, extra=extra, written=tuple(values))


def given_card(given: GivenCard | None) -> StoreCard:
    """The card of fields that somebody wrote by hand, if any: what looks like a known field, mistyped, is refused.
    Cards in files are read by `complete_card` alone, whatever they hold."""
    given = {} if given is None else given
    for name in given if isinstance(given, dict) else ():
        near = difflib.get_close_matches(str(name), FIELDS, n=1, cutoff=LIKELY)
        if near and name not in FIELDS:
            raise StoreError(f"The card has '{name}', which is no field of it; did you mean '{near[0]}'?")
    return complete_card(given)


def regenerated(card: dict) -> bool:
    """Whether `ringfence data make` made the steps: the same anywhere, but for a processor's rounding."""
    return str(card.get("provenance", "")).startswith("regenerated")


def other_data(here: dict, there: dict) -> list[tuple[str, object, object]]:
    """(name, here, there) of what two cards contradict each other in; a field that one of them lacks says nothing, and
    neither does the digest of regenerated data, which another processor rounds otherwise."""
    both = [k for k in ORIGIN if k in here and k in there]
    rounded = {"content"} if regenerated(here) and regenerated(there) else set()
    return [(k, here[k], there[k]) for k in both if k not in rounded and here[k] != there[k]]


def validate(store: Arrays) -> None:
    """Raise `StoreError` naming the array, the rule it breaks and the remedy."""
    for rule in STORE_RULES:
        rule(store)


# --- rules of a card, which they also bring into its stored form ---
def _task_is_a_name(card: dict) -> None:
    try:
        schemas.check(card["task"], schemas.Name)
        named = bool(card["task"].strip())
    except ValueError:
        named = False
    if not named:
        raise StoreError(
            f"The card has task={repr(card['task'])[:200]}; it must be a name without slashes, line breaks or a "
            "leading dot or dash, of at most 120 letters, since folders of runs are called so."
        )


def _action_bounds(card: dict) -> None:
    bounds = Bounds.of(card["action_low"], card["action_high"])
    card["action_low"] = stored_bound(bounds.low)
    card["action_high"] = stored_bound(bounds.high)


def _constraint_limits(card: dict) -> None:
    limits = card.get("constraints")
    if limits is None:
        return
    try:
        limits = {name: x.item() if isinstance(x, np.number) else x for name, x in limits.items()}
        schemas.check(limits, schemas.Limits)
    except (AttributeError, ValueError):
        raise StoreError(
            f"The card has constraints={repr(limits)[:200]}; it must give each constraint's name a limit, the cost "
            "of an episode that is not to be passed, 0 or more."
        ) from None
    card["constraints"] = limits
    card.setdefault("cost_limit", float(sum(limits.values())))


def _words(card: dict) -> None:
    for name in WORDS:
        if not isinstance(card.get(name), str | None):
            raise StoreError(f"The card has {name}={repr(card[name])[:200]}; it must be text, or be left out.")
    for name in (*LISTS_OF_NAMES, "agents", "warnings"):
        words = card.get(name)
        words = words.tolist() if isinstance(words, np.ndarray) else words
        if words is not None and not (isinstance(words, list | tuple) and all(isinstance(w, str) for w in words)):
            of_each = isinstance(words, list | tuple) and all(isinstance(w, list | tuple) for w in words)
            rule = "a list of words, or be left out"
            if of_each:
                rule = (
                    "one list of words for all agents: an entry for each quantity, 0 where an agent has none "
                    "(ringfence.Layout makes such arrays)"
                )
            raise StoreError(f"The card has {name}={str(words)[:200]}; it must be {rule}.")
        if name in card:
            card[name] = words if words is None else list(words)
    for name in LISTS_OF_NAMES:
        names = card.get(name) or []
        wrong = [one for k, one in enumerate(names) if one in names[:k] or not one.isprintable()]
        if wrong:
            raise StoreError(
                f"The card has {name} with {wrong[0]!r} twice or unprintable; give every entry its own name."
            )


def _is_number(x) -> bool:
    try:
        return isinstance(x, int | float | np.number) and not isinstance(x, bool) and math.isfinite(x)
    except (OverflowError, TypeError):  # an integer of hundreds of digits; a complex number
        return False


# What fields must be, where the card has them: a test, and it in words.
SINGLE: dict[str, tuple[Callable[[Any], bool], str]] = {
    "cost_limit": (lambda x: _is_number(x) and x >= 0, "one number, 0 or more"),
    "sensing_radius": (
        lambda x: x is None or x == math.inf or (_is_number(x) and x > 0),
        "a number of metres above 0",
    ),
    "dt": (lambda x: _is_number(x) and x > 0, "the seconds of a step, a number above 0"),
    "team": (
        lambda x: x is None or (_is_number(x) and x >= 1 and float(x).is_integer()),
        "the number of agents of a team, 1 or more",
    ),
    "action_delay": (
        lambda x: _is_number(x) and x >= 0 and float(x).is_integer(),
        "a whole number of steps, 0 or more",
    ),
    "homogeneous": (lambda x: isinstance(x, bool), "true or false"),
}


def _numbers(card: dict) -> None:
    for name, (is_sound, rule) in SINGLE.items():
        if name in card and not is_sound(card[name]):
            raise StoreError(f"The card has {name}={repr(card[name])[:200]}; it must be {rule}.")
    if "action_delay" in card:
        card["action_delay"] = int(card["action_delay"])
    for name in ORIGINS:
        origins = card.get(name)
        origins = origins.tolist() if isinstance(origins, np.ndarray) else origins
        if origins is not None and not (isinstance(origins, list | tuple) and all(_is_number(x) for x in origins)):
            raise StoreError(
                f"The card has {name}={repr(origins)[:200]}; it must be a list of numbers, what was subtracted from "
                "each entry, or be left out."
            )
        if name in card:
            card[name] = origins if origins is None else [float(x) for x in origins]


def _hazard(card: dict) -> None:
    if isinstance(card["hazard"], constraints.Hazard):
        card["hazard"] = constraints.to_dict(card["hazard"])
    elif not isinstance(card["hazard"], dict):
        raise StoreError(
            f"The card has hazard={card['hazard']!r}; it must be a Separation, SpeedLimit, CostColumn or All (other "
            "dangers go into the costs, with CostColumn)."
        )
    try:
        hazard = constraints.from_dict(card["hazard"])
        parts = hazard.hazards if isinstance(hazard, constraints.All) else (hazard,)
        sound = all(_is_sound(part) for part in parts)
    except UserError:
        raise
    except (TypeError, ValueError):  # a field of a kind that no hazard has
        sound = False
    if not sound:
        raise StoreError(f"The card has hazard={card['hazard']!r}, which is none; see docs/data.md.")


def _is_sound(hazard: constraints.Hazard) -> bool:
    """Whether a hazard has the sizes that define it, and names its features with words."""
    match hazard:
        case constraints.Separation():
            return hazard.radius is not None and hazard.safe_margin is not None
        case constraints.SpeedLimit():
            features = hazard.features
            named = isinstance(features, tuple) and all(isinstance(name, str) for name in features)
            return hazard.limit is not None and named and bool(features)
        case _:
            return True


CARD_RULES = (_task_is_a_name, _action_bounds, _constraint_limits, _words, _numbers, _hazard)


# --- rules of a store's arrays, in the order in which they can be asked ---
def _demand(ok: bool, message: str) -> None:
    if not ok:
        raise StoreError(message)


def _arrays(store: Arrays) -> list[tuple[str, np.ndarray]]:
    """Those that are there, by name."""
    optional = [(name, getattr(store, name)) for name in OPTIONAL]
    return [(name, getattr(store, name)) for name in ARRAYS] + [(k, x) for k, x in optional if x is not None]


def _kinds(store: Arrays) -> None:
    """Arrays of NumPy's, of whole numbers, truth values or real numbers."""
    expected = {
        "episode_ends": ("iu", "whole numbers"),
        "terminated": ("b", "true or false"),
        "truncated": ("b", "true or false"),
    }
    for name, array in _arrays(store):
        _demand(isinstance(array, np.ndarray), f"{name} is a {type(array).__name__}; give a NumPy array.")
        _demand(
            not np.ma.is_masked(array), f"{name} hides entries behind a mask; fill them in, or drop their episodes."
        )
        kinds, what = expected.get(name, ("biuf", "real numbers"))
        _demand(array.dtype.kind in kinds, f"{name} holds entries of type {array.dtype}; it must hold {what}.")
        _demand(array.dtype.isnative, f"{name} holds bytes in the order of another machine; call .astype('f4') on it.")


def _steps(store: Arrays) -> None:
    """Actions of some agents, and episodes that hold all of them."""
    shape = store.actions.shape
    _demand(len(shape) == 3, f"actions has shape {shape}, expected (T, N, A); add the missing axis.")
    _demand(
        shape[1] > 0 and shape[2] > 0,
        f"actions has shape {shape}; a store needs at least one agent and one action entry.",
    )
    ends = store.episode_ends
    steps = len(store.actions)
    _demand(ends.ndim == 1 and len(ends) > 0, "episode_ends is empty; a store needs at least one whole episode.")
    _demand(bool((np.diff(ends, prepend=0) > 0).all()), "episode_ends must increase; give cumulative step counts.")
    _demand(
        ends[-1] == steps, f"episode_ends ends at {ends[-1]}, actions has {steps} steps; drop an unfinished episode."
    )


def _shapes(store: Arrays) -> None:
    steps, n_agents = store.actions.shape[:2]
    episodes = len(store.episode_ends)
    shapes = {
        "observations": (steps + episodes, n_agents),
        "rewards": (steps, n_agents),
        "costs": (steps, n_agents) if np.ndim(store.costs) == 2 else (steps,),
        "terminated": (steps,),
        "truncated": (steps,),
    }
    for name, expected in shapes.items():
        shape = getattr(store, name).shape
        own_axes = int(name == "observations")  # the entries, of any number
        _demand(
            shape[: len(expected)] == expected and len(shape) == len(expected) + own_axes,
            f"{name} has shape {shape}, expected {(*expected, 'O') if own_axes else expected} for "
            f"{steps} steps, {episodes} episodes and {n_agents} agents; every episode keeps one more observation than "
            "steps.",
        )
    _demand(store.observations.shape[2] > 0, "observations has no entries; an agent must see at least one number.")
    if store.state is not None:
        _demand(
            store.state.ndim == 2 and len(store.state) == steps + episodes,
            f"state has shape {store.state.shape}, expected ({steps + episodes}, S); keep the state each episode "
            "ended in.",
        )
    if store.speed is not None:
        _demand(
            store.speed.shape == (steps,),
            f"speed has shape {store.speed.shape}, expected ({steps},); give one of every step.",
        )


def _first(store: Arrays, name: str, wrong: np.ndarray) -> str:
    """The first entry of an array that is wrong, and where it stands."""
    where = tuple(int(i) for i in np.argwhere(wrong)[0])
    ends = store.episode_ends + (np.arange(1, len(store.episode_ends) + 1) if name in ROWS else 0)
    episode = int(np.searchsorted(ends, where[0], side="right"))
    step = where[0] - (int(ends[episode - 1]) if episode else 0)
    return f"{name}{list(where)} is {getattr(store, name)[where]:.4g} (episode {episode}, step {step})"


def _demand_no_negative(name: str, store: Arrays) -> None:
    negative = getattr(store, name) < 0
    if negative.any():
        raise StoreError(
            f"{name} holds negative entries: {_first(store, name, negative)}; a cost is 0 or positive, check its sign."
        )


def _sizes(store: Arrays) -> None:
    """Finite numbers that can be learned from; costs of 0 and above, known of every step."""
    known = np.isfinite(store.costs).mean()
    _demand(
        known > 0.5 or known == 1,
        f"costs is known for {100 * known:.2g} % of the steps; say 0 or 1 of every step that is kept, and drop "
        "episodes of which nobody knows.",
    )
    for name, array in _arrays(store):
        if name in ("terminated", "truncated", "episode_ends"):
            continue
        if not np.isfinite(array).all():
            raise StoreError(f"{_first(store, name, ~np.isfinite(array))}; remove or repair that episode.")
        most = float(np.abs(array).max(initial=0))
        _demand(
            most <= LARGEST,
            f"{name} reaches {most:.3g}, beyond {LARGEST:g}, what 32 bits can be learned from; scale it.",
        )
    _demand_no_negative("costs", store)


def _constraints(store: Arrays) -> None:
    """Named in the card, and the costs are the largest of them."""
    limits = store.limits
    if store.constraints is None and not limits:
        return
    shape = () if store.constraints is None else store.constraints.shape
    if store.constraints is None or shape != (*store.costs.shape, len(limits)):
        raise StoreError(
            f"constraints has shape {shape}, its card names {len(limits)} ({', '.join(limits) or 'none'}) for "
            f"costs of {store.costs.shape}; give costs={{name: array, ...}}, and a limit for each in the card."
        )
    _demand_no_negative("constraints", store)
    _demand(
        bool(np.array_equal(store.constraints.max(-1), store.costs)),
        "costs is not the largest of the constraints at every step; give costs={name: array, ...} alone.",
    )


def _actions_within_bounds(store: Arrays) -> None:
    bounds = store.card.bounds
    agents, entries = store.actions.shape[1:]
    _demand(
        bounds.fit(agents, entries),
        f"The card bounds actions by {bounds}, and the data has {agents} agents with {entries} action entries each; "
        "give one number, or one of each entry.",
    )
    _demand(
        not (store.card.homogeneous and bounds.by_agent),
        "The card has homogeneous=True and other action bounds of some agents; homogeneous agents have the same ones.",
    )
    outside = bounds.outside(store.actions)
    if outside.any():
        where = tuple(int(i) for i in np.argwhere(outside)[0])
        low, high = bounds.of_entry(*where[1:])
        raise StoreError(
            f"actions{list(where)} is {store.actions[where]:.4g}, outside [{low:g}, {high:g}]; rescale the actions or "
            "set action_low and action_high in the card."
        )


def _episodes_end_in_one_way(store: Arrays) -> None:
    both = store.terminated & store.truncated
    _demand(not both.any(), "terminated and truncated are both set somewhere; a step ends in one way, keep terminated.")
    last = np.zeros(len(store.actions), bool)
    last[store.episode_ends - 1] = True
    over = store.terminated | store.truncated
    if (last & ~over).any():
        unfinished = int(np.flatnonzero(~over[store.episode_ends - 1])[0])
        raise StoreError(
            f"Episode {unfinished} is unfinished: its last step is neither terminated nor truncated; set one or drop "
            "it."
        )
    _demand(not (over & ~last).any(), "A step inside an episode is flagged as its end; split the episode there.")


def _agents_as_the_card_says(store: Arrays) -> None:
    card, (n_agents, widest) = store.card, store.actions.shape[1:]
    sizes = card.action_sizes
    if sizes is not None:
        counted = isinstance(sizes, list | tuple) and len(sizes) == n_agents
        _demand(
            counted and all(type(size) is int and 1 <= size <= widest for size in sizes),
            f"The card has action_sizes={sizes!r}; it must say for each of the {n_agents} agents how many entries its "
            f"action has, 1 to {widest}.",
        )
    _demand(
        card.team is None or n_agents == 1,
        f"The card has team={card.team}, which logs of single agents have that were split from a team's, and the "
        f"data has {n_agents} agents; leave it out.",
    )
    if card.agents is not None and n_agents > 1:  # logs of one at a time may be of many
        _demand(
            len(set(card.agents)) == n_agents,
            f"The card names the agents {str(card.agents)[:SHOWN]}, the data has {n_agents}; give each its own name.",
        )


def _entries_as_the_card_says(store: Arrays) -> None:
    card, size = store.card, store.observations.shape[2]
    if names := card.observation_names:
        _demand(len(names) == size, f"The card names {len(names)} observation entries, the data has {size}.")
    if (names := card.state_names) and store.state is not None:
        size = store.state.shape[1]
        _demand(len(names) == size, f"The card names {len(names)} state entries, not {size}.")
    for field, array in zip(ORIGINS, (store.observations, store.state)):
        origins = getattr(card, field)
        if origins is not None and array is not None:
            size = array.shape[-1]
            _demand(len(origins) == size, f"The card has {len(origins)} {field}, the data has {size} such entries.")


STORE_RULES = (
    _kinds,
    _steps,
    _shapes,
    _sizes,
    _constraints,
    _actions_within_bounds,
    _episodes_end_in_one_way,
    _agents_as_the_card_says,
    _entries_as_the_card_says,
)
