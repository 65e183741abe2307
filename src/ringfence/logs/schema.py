"""What a store must be: the rules of its card and of its arrays, each refused by name with the remedy."""

from __future__ import annotations

import json
from typing import Any, Protocol

import numpy as np

from ringfence.errors import StoreError, UserError
from ringfence.problem import constraints
from ringfence.utils import schemas

ARRAYS = ("observations", "actions", "rewards", "costs", "terminated", "truncated", "episode_ends")
OPTIONAL = ("state", "speed", "constraints")


class Arrays(Protocol):
    """What a store shows to its rules; the axes are those of `store.py`."""

    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    costs: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    episode_ends: np.ndarray
    state: np.ndarray | None
    speed: np.ndarray | None
    constraints: np.ndarray | None
    card: dict[str, Any]

    @property
    def limits(self) -> dict[str, float]: ...


def complete_card(card: dict) -> dict:
    """A card with every field present; unknown fields are kept, for provenance of any kind."""
    base = {
        "task": "custom",
        "simulator": None,
        "provenance": "user data",
        "action_low": -1.0,
        "action_high": 1.0,
        "observation_names": None,
        "state_names": None,
        "hazard": {"kind": "CostColumn"},
    }
    if not isinstance(card, dict):
        raise StoreError(f"The card is a {type(card).__name__}; it must be a dictionary of fields.")
    card = {**base, **card}
    _check_name(card["task"])
    for name in ("action_low", "action_high"):
        if not _is_number(card[name]):
            raise StoreError(f"The card has {name}={card[name]!r}; it must be one number, the bound of every entry.")
        card[name] = float(card[name])
    if not card["action_low"] < card["action_high"]:
        raise StoreError(
            f"The card has action_low={card['action_low']:g} and action_high={card['action_high']:g}; the first must "
            "be the smaller one."
        )
    if "cost_limit" in card and not (_is_number(card["cost_limit"]) and card["cost_limit"] >= 0):
        raise StoreError(f"The card has cost_limit={card['cost_limit']!r}; it must be one number, 0 or more.")
    limits = card.get("constraints")
    if limits is not None:
        try:
            limits = card["constraints"] = {k: _plain(v) for k, v in limits.items()}
            schemas.check(limits, schemas.Limits)
        except (AttributeError, ValueError):
            raise StoreError(
                f"The card has constraints={repr(limits)[:200]}; it must give each constraint's name a limit, the cost "
                "of an episode that is not to be passed, 0 or more."
            ) from None
        card["cost_limit"] = card.get("cost_limit", float(sum(limits.values())))
    for name in ("observation_names", "state_names", "warnings"):
        words = card.get(name)
        words = words.tolist() if isinstance(words, np.ndarray) else words
        if words is not None and not (isinstance(words, list | tuple) and all(isinstance(w, str) for w in words)):
            raise StoreError(f"The card has {name}={words!r}; it must be a list of words, or be left out.")
        if name in card:
            card[name] = words if words is None else list(words)
        told = card[name] if name != "warnings" and card.get(name) else ()
        twice = [w for k, w in enumerate(told) if w in told[:k] or not w.isprintable()]
        if twice:
            raise StoreError(
                f"The card has {name} with {twice[0]!r} twice or unprintable; give every entry its own name."
            )
    if "dt" in card and not (_is_number(card["dt"]) and card["dt"] > 0):
        raise StoreError(f"The card has dt={card['dt']!r}; it must be the seconds of a step, a number above 0.")
    if not isinstance(card.get("alike", False), bool):
        raise StoreError(f"The card has alike={card['alike']!r}; it must be true or false.")
    if isinstance(card["hazard"], constraints.Hazard):
        card["hazard"] = constraints.to_dict(card["hazard"])
    elif not isinstance(card["hazard"], dict):
        raise StoreError(
            f"The card has hazard={card['hazard']!r}; it must be a Separation, SpeedLimit, CostColumn or All (other "
            "dangers go into the costs, with CostColumn)."
        )
    try:
        told = constraints.from_dict(card["hazard"])
        sound = all(_is_sound(h) for h in getattr(told, "hazards", (told,)))
    except UserError:
        raise
    except (TypeError, ValueError):  # a field of a kind that no hazard has
        sound = False
    if not sound:
        raise StoreError(f"The card has hazard={card['hazard']!r}, which is none; see docs/data.md.")
    try:
        return json.loads(json.dumps(card, default=lambda x: x.tolist()))  # NumPy's arrays and numbers become plain
    except (AttributeError, TypeError, ValueError) as error:
        raise StoreError(f"The card cannot be kept as JSON ({error}); use words, numbers, lists and dicts.") from None


def _is_number(x) -> bool:
    return isinstance(x, int | float | np.number) and not isinstance(x, bool) and bool(np.isfinite(x))


def _plain(x):
    """A number of NumPy's as Python's."""
    return x.item() if isinstance(x, np.number) else x


def _is_sound(hazard: constraints.Hazard) -> bool:
    """Whether a hazard has the sizes that define it, and names its features with words."""
    features = getattr(hazard, "features", ())
    sizes = ("radius", "safe_margin") if isinstance(hazard, constraints.Separation) else ("limit",)
    sized = all(getattr(hazard, name, 0.0) is not None for name in sizes)
    named = isinstance(features, tuple) and all(isinstance(name, str) for name in features)
    return sized and named and (bool(features) or not isinstance(hazard, constraints.SpeedLimit))


def _is_name(word) -> bool:
    """Whether a word can become that of a folder or file."""
    try:
        schemas.check(word, schemas.Name)
    except ValueError:
        return False
    return bool(word.strip())


def _check_name(task) -> None:
    if not _is_name(task):
        raise StoreError(
            f"The card has task={repr(task)[:200]}; it must be a name without slashes, line breaks or a leading dot or "
            "dash, of at most 120 letters, since folders of runs are called so."
        )


def validate(store: Arrays) -> None:
    """Raise `StoreError` naming the array, the rule it breaks and the remedy."""
    s = store

    def demand(ok: bool, message: str) -> None:
        if not ok:
            raise StoreError(message)

    for name in (*ARRAYS, *OPTIONAL):
        array = getattr(s, name)
        if array is None and name in OPTIONAL:
            continue
        demand(isinstance(array, np.ndarray), f"{name} is a {type(array).__name__}; give a NumPy array.")
        kinds, what = {"episode_ends": ("iu", "whole numbers")}.get(name, ("biuf", "real numbers"))
        if name in ("terminated", "truncated"):
            kinds, what = "b", "true or false"
        demand(array.dtype.kind in kinds, f"{name} holds entries of type {array.dtype}; it must hold {what}.")
    demand(s.actions.ndim == 3, f"actions has shape {s.actions.shape}, expected (T, N, A); add the missing axis.")
    t, n = s.actions.shape[:2]
    demand(
        n > 0 and s.actions.shape[2] > 0,
        f"actions has shape {s.actions.shape}; a store needs at least one agent and one action entry.",
    )
    ends = s.episode_ends
    demand(ends.ndim == 1 and len(ends) > 0, "episode_ends is empty; a store needs at least one whole episode.")
    demand(bool((np.diff(ends, prepend=0) > 0).all()), "episode_ends must increase; give cumulative step counts.")
    demand(ends[-1] == t, f"episode_ends ends at {ends[-1]}, actions has {t} steps; drop an unfinished episode.")
    e = len(ends)
    shapes = {
        "observations": (t + e, n),
        "rewards": (t, n),
        "costs": (t, n) if np.ndim(s.costs) == 2 else (t,),
        "terminated": (t,),
        "truncated": (t,),
    }
    for name, expected in shapes.items():
        got = getattr(s, name).shape
        demand(
            got[: len(expected)] == expected and len(got) == len(expected) + (name == "observations"),
            f"{name} has shape {got}, expected {(*expected, 'O') if name == 'observations' else expected} for "
            f"{t} steps, {e} episodes and {n} agents; every episode keeps one more observation than steps.",
        )
    demand(s.observations.shape[2] > 0, "observations has no entries; an agent must see at least one number.")
    if s.state is not None:
        demand(
            s.state.ndim == 2 and len(s.state) == t + e,
            f"state has shape {s.state.shape}, expected ({t + e}, S); keep the state each episode ended in.",
        )
    known = np.isfinite(s.costs).mean()
    demand(
        known > 0.5 or known == 1,
        f"costs is known for {100 * known:.2g} % of the steps; say 0 or 1 of every step that is kept, and drop "
        "episodes of which nobody knows.",
    )
    if s.speed is not None:
        demand(s.speed.shape == (t,), f"speed has shape {s.speed.shape}, expected ({t},); give one of every step.")
    for name in ("observations", "actions", "rewards", "costs", *OPTIONAL):
        array = getattr(s, name)
        if array is not None and not np.isfinite(array).all():
            where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
            raise StoreError(f"{name}{list(where)} is {array[where]}; remove or repair the episode that holds it.")
    demand(bool((s.costs >= 0).all()), "costs holds negative entries; a cost is 0 or positive, check its sign.")
    if s.constraints is not None or s.limits:
        shape, wanted = np.shape(s.constraints), (*s.costs.shape, len(s.limits))
        demand(
            shape == wanted,
            f"constraints has shape {shape}, its card names {len(s.limits)} ({', '.join(s.limits) or 'none'}) for "
            f"costs of {s.costs.shape}; give costs={{name: array, ...}}, and a limit for each in the card.",
        )
        demand(
            bool((s.constraints >= 0).all()),
            "constraints holds negative entries; a cost is 0 or positive, check its sign.",
        )
        demand(
            bool(np.array_equal(s.constraints.max(-1), s.costs)),
            "costs is not the largest of the constraints at every step; give costs={name: array, ...} alone.",
        )
    low, high = s.card["action_low"], s.card["action_high"]
    slack = 1e-4 * (high - low)
    outside = (s.actions < low - slack) | (s.actions > high + slack)
    if outside.any():
        where = tuple(int(i) for i in np.argwhere(outside)[0])
        raise StoreError(
            f"actions{list(where)} is {s.actions[where]:.4g}, outside [{low:g}, {high:g}]; rescale the actions or set "
            "action_low and action_high in the card."
        )
    both = s.terminated & s.truncated
    demand(not both.any(), "terminated and truncated are both set somewhere; a step ends in one way, keep terminated.")
    last = np.zeros(t, bool)
    last[ends - 1] = True
    over = s.terminated | s.truncated
    if (last & ~over).any():
        bad = int(np.flatnonzero(~over[ends - 1])[0])
        raise StoreError(
            f"Episode {bad} is unfinished: its last step is neither terminated nor truncated; set one or drop it."
        )
    demand(not (over & ~last).any(), "A step inside an episode is flagged as its end; split the episode there.")
    sizes, most = s.card.get("action_sizes"), s.actions.shape[2]
    if sizes is not None:
        told = isinstance(sizes, list | tuple) and len(sizes) == n
        demand(
            told and all(type(k) is int and 1 <= k <= most for k in sizes),
            f"The card has action_sizes={sizes!r}; it must say for each of the {n} agents how many entries its action "
            f"has, 1 to {most}.",
        )
    for key, size in (("observation_names", s.observations.shape[2]), ("state_names", s.state is not None)):
        names = s.card.get(key)
        if names and key == "observation_names":
            demand(len(names) == size, f"The card names {len(names)} observation entries, the data has {size}.")
        if names and key == "state_names" and s.state is not None:
            demand(
                len(names) == s.state.shape[1], f"The card names {len(names)} state entries, not {s.state.shape[1]}."
            )
