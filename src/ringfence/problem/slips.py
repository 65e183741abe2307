"""Names of entries that look like slips of the pen, and would leave an entry without the place that its name gives it.

A name is `body.what`, and bodies tell alike things: who has a `dx` has a `dy`, and `other1` has what `other0` has.
"""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Iterable, Mapping

NEAR = 0.75  # how alike two names are, of difflib's ratio: `othr0` and `other0` 0.91, `goal` and `own` 0.29
LONGEST = 60  # letters of a name that are
MOST = 200  # names that are compared: each with each
DIGITS = "0123456789"
TWINS = {"x": "y", "y": "x"}  # the last letter of what is told along each axis

Bodies = Mapping[str, set[str]]  # what each is told of


def slips(names: Iterable[str]) -> list[str]:
    """A sentence for each pair of names that a letter or two keep apart."""
    bodies: dict[str, set[str]] = {}
    for name in itertools.islice(names, MOST):
        body, dot, what = name.partition(".")
        if dot:
            bodies.setdefault(body, set()).add(what)
    pairs = [*_two_bodies(bodies), *_two_words(bodies)]
    return [
        f"'{one}' and '{other}' look like one kind of entry, spelt in two ways; name them alike."
        for one, other in pairs
    ]


def _two_bodies(bodies: Bodies) -> list[tuple[str, str]]:
    """`othr0.dx` and `other0.dy`, each without the other axis."""
    found = []
    for one, other in itertools.combinations(bodies, 2):
        if one.rstrip(DIGITS) == other.rstrip(DIGITS) or not _near(one, other):
            continue
        for what in sorted(bodies[one]):
            twin = what[:-1] + TWINS.get(what[-1:], "")
            if twin in bodies[other] - bodies[one] and what not in bodies[other]:
                found.append((f"{one}.{what}", f"{other}.{twin}"))
    return found


def _two_words(bodies: Bodies) -> list[tuple[str, str]]:
    """`other0.ddx` and `other1.dx`, each without what the other is told of."""
    found = []
    for one, other in itertools.combinations(bodies, 2):
        if one.rstrip(DIGITS) != other.rstrip(DIGITS) or one.rstrip(DIGITS) == one:
            continue
        for what in sorted(bodies[one] - bodies[other]):
            found += [(f"{one}.{what}", f"{other}.{w}") for w in bodies[other] - bodies[one] if _near(what, w)]
    return found


def _near(one: str, other: str) -> bool:
    return difflib.SequenceMatcher(None, one[:LONGEST], other[:LONGEST]).ratio() >= NEAR
