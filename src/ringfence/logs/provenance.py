"""Whether two data cards are of the same steps."""

from __future__ import annotations

from ringfence.problem.origins import FIELDS as ORIGINS

# What a card says of where its steps come from; the rest describes them, and later versions describe more.
ORIGIN = ("task", "provenance", "simulator", "integrator", "reward", "seed", "transitions", "hazard", "content")
ORIGIN += ORIGINS


def regenerated(card: dict) -> bool:
    """Whether `ringfence data make` made the steps: the same anywhere, but for a processor's rounding."""
    return str(card.get("provenance", "")).startswith("regenerated")


def other_data(here: dict, there: dict) -> list[tuple[str, object, object]]:
    """(name, here, there) of what two cards contradict each other in; a field that one of them lacks says nothing, and
    neither does the digest of regenerated data, which another processor rounds otherwise."""
    both = [k for k in ORIGIN if k in here and k in there]
    rounded = {"content"} if regenerated(here) and regenerated(there) else set()
    return [(k, here[k], there[k]) for k in both if k not in rounded and here[k] != there[k]]
