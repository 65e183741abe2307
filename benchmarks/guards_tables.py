"""Tables of guards on docs/results.md and docs/proving-ground.md, and the questions that claims ask of rows beside
their paired baselines (tables.py writes the pages)."""

from __future__ import annotations

import functools
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import evidence
import numpy as np
from common import RESULTS, markdown
from evidence import Difference, Row, difference, family, of, proven, tasks_of, variant

from ringfence.evaluation.statistics import upper_bound
from ringfence.report import board

SHIELD, FULL, ADAPT = "+shield-learned", "+full-learned", "+adapt-learned"
OF_SEEDS = "\n\n[n]: of n seeds, but where a cell says another number."

# Proposals and guards on Simple Spread: their words, the suite, and their row.
TIERS = ("expert", "medium", "medium-replay", "random")
CROSSED: dict[str, tuple[str, Row]] = {
    "logs": ("guards", ("behaviour data", "reference")),
    "do nothing": ("guards", ("do-nothing", "reference")),
    "BC": ("guards", ("bc", "default")),
    "return-conditioned BC": ("guards", ("bc-return", "default")),
    "MA-TD3+BC": ("guards", ("ma-td3bc", "default")),
    "MA-TD3+BC, Lagrange": ("guards", ("ma-td3bc-lag", "default")),
    "OMAR": ("guards", ("omar", "default")),
    "FISOR per agent": ("simple_spread", ("fisor", "default")),
    # guards other than the shield that learned
    "BC under `full`": ("guards", ("bc", f"default{FULL}")),
    "MPC from a zero proposal (`mpc`) under `full`": ("guards", ("mpc", f"default{FULL}")),
    "BC under shield, decentralized": ("own-sight", ("bc", f"default{SHIELD}-decentralized")),
    "BC under `full`, decentralized": ("own-sight", ("bc", f"default{FULL}-decentralized")),
}
# Pan et al. 2022, means as tabulated in MADIFF's repository; on the public files.
PUBLISHED = {
    "published: MA-TD3+BC, public data": (1.083, 0.293, 0.154, 0.098),
    "published: OMAR, public data": (1.149, 0.479, 0.379, 0.344),
}
# Ways to act on robots, in the same form; limits are native and by quantile.
ON_ROBOTS: dict[str, tuple[str, Row]] = {
    "BC": ("mujoco", ("bc", "default")),
    "MA-TD3+BC, Lagrange": ("mujoco", ("ma-td3bc-lag", "default")),
    "FISOR per agent": ("mujoco", ("fisor", "default")),
    "BC under `adapt`": ("guards-mujoco", ("bc", f"default{ADAPT}")),
    "BC under `adapt`, *analytic*": ("guards-mujoco", ("bc", "default+adapt-analytic")),
    "BC under `full`": ("guards-mujoco", ("bc", f"default{FULL}")),
    "BC under `full`, *analytic*": ("guards-mujoco", ("bc", "default+full-analytic")),
    "BC under `adapt`, decentralized": ("own-sight-mujoco", ("bc", f"default{ADAPT}-decentralized")),
    "MPC from a zero proposal under `full`": ("guards-mujoco", ("mpc", f"default{FULL}")),
}
# Crossing's rows: algorithm and variant, and their words.
WAYS: dict[str, Row] = {
    "certificates (true state and brakes)": ("certificates", "reference"),
    "BC": ("bc", "default"),
    **{
        f"shield, ℓ, {k} step{'s' * (k > 1)}": ("bc", f"default{SHIELD}+horizon{k}+terminal_valueFalse") for k in (1, 7)
    },
    "shield, ℓ and V, 1 step": ("bc", f"default{SHIELD}+horizon1"),
    "**shield, ℓ and V, 3 steps**": ("bc", f"default{SHIELD}"),
    "return-conditioned BC, shield": ("bc-return", f"default{SHIELD}"),
    "**full**": ("bc", f"default{FULL}"),
}


def of_seeds(suite: str, task: str, row: Row, keys: tuple[str, str], digits: tuple[int, int]) -> tuple[str, int]:
    """Two means of a row on a task, as words, and of how many seeds."""
    here = variant(task, row)
    means = [(evidence.mean(suite, task, here, key), n) for key, n in zip(keys, digits)]
    words = "–" if means[0][0] is None else " / ".join(f"{value:z.{n}f}" for value, n in means)
    return words, len(of(suite, task, here))


def usual(counts: Iterable[int]) -> int:
    """The most common number of seeds."""
    return Counter(n for n in counts if n).most_common(1)[0][0]


def crossed() -> str:
    """A line per proposal, a column per tier: normalised return / cost of resets that start safely → return under a
    shield that learned, whose cost is nothing."""
    columns = []
    for tier in TIERS:
        task, cells = f"simple_spread-{tier}", []
        for suite, row in CROSSED.values():
            text, seeds = of_seeds(suite, task, row, ("return_norm", "cost_safe_start"), (2, 2))
            guarded = evidence.mean(suite, task, variant(task, (row[0], row[1] + SHIELD)), "return_norm")
            text += f" → {guarded:z.2f}" if guarded is not None else ""
            cells.append((text, seeds if row[1] != "reference" else 0))
        most = usual(n for _, n in cells)
        marked = [text + (f" [{n}]" if n not in (0, most) else "") for text, n in cells]
        columns.append((f"{tier} [{most}]", *marked))
    heads, *lines = zip(("proposal", *CROSSED), *columns)
    lines += [(f"*{name}*", *(f"*{v:.2f}*" for v in values)) for name, values in PUBLISHED.items()]
    return markdown(heads, lines) + OF_SEEDS


def robots() -> str:
    """A line per way to act: limits kept, by the upper end of the cost's interval, and what is earned of the scale."""
    lines = []
    for words, (suite, row) in ON_ROBOTS.items():
        kept, earned, fell, seeds = Counter(), [], [], set()
        for task, found in board.read(RESULTS / suite).lines.items():
            for line in found:
                if line.method is not None and (line.method.algorithm, line.method.variant) == row:
                    limit = "quantile" if task.endswith("-quantile") else "native"
                    kept[limit, "of"] += 1
                    kept[limit] += line.safe
                    earned.append(line.returns_norm)
                    fell.append(evidence.mean(suite, task, variant(task, row), "termination_rate"))
                    seeds.add(len(line.seeds))
        cells = [f"{kept[limit]} of {kept[limit, 'of']}" if kept[limit, "of"] else "–" for limit in LIMITS]
        lines.append((words, *cells, f"{np.mean(earned):.2f}", f"{100 * np.mean(fell):.0f} %", min(seeds)))
    return markdown(("who acts", "native limits kept", "quantile", "return", "falls", "seeds"), lines)


LIMITS = ("native", "quantile")


def crossing() -> str:
    """A line per way to act on `crossing-hasty`."""
    lines = []
    for words, row in WAYS.items():
        found = list(of("crossing-guards", "crossing-hasty", row).values())
        lines.append((words, f"{np.mean([r['return_mean'] for r in found]):.2f}", touching(found)))
    return markdown(("method", "return", "episodes with contact (bound)"), lines)


def touching(found: Sequence[dict]) -> str:
    """The share of episodes with contact, and its bound. Seeds share their resets, so the bound is of one: the seed
    that touches most."""
    episodes = int(found[0]["episodes"])
    rates = [float(r["violation_rate"]) for r in found]
    bound = upper_bound(round(max(rates) * episodes), episodes)
    return f"{100 * np.mean(rates):.3g} % (≤ {100 * bound:.3g} %)"


# The sixteen systems of the proving ground.
GUARDED = {"none": "", "shield learned": "shield", "cbf-qp": "CBF-QP", "shield oracle": "oracle"}


def proving() -> str:
    """A line per system: verdict, causes, and the percentage of episodes with a violation, by driver and guard."""
    drivers = {"bc": "clone", "naive": "naive"}
    heads = ["system", "verdict", "causes found", *(head or d for d in drivers.values() for head in GUARDED.values())]
    lines = []
    for found in proven():
        causes = dict.fromkeys(_in_short(cause) for cause in found["causes"])
        cells = [f"`{found['task'].removeprefix('proving-')}`", _verdicts(found), "; ".join(causes) or "none"]
        lines.append(cells + [_share(found["rows"].get(f"{driver} {row}")) for driver in drivers for row in GUARDED])
    return markdown(heads, lines)


def _verdicts(found: dict) -> str:
    """What the Worlds of all seeds say of themselves."""
    words = Counter(found["verdicts"])
    return next(iter(words)) if len(words) == 1 else ", ".join(f"{word} by {n}" for word, n in words.items())


def _in_short(cause: str) -> str:
    """A cause without the agents that it is of, and a distance by its name."""
    return re.sub(r"^length of (\w+)\.d\w, (?:\w+\.)?d\w", r"distance to \1", re.sub(" of agent.*", " of some", cause))


def _share(row: dict | None) -> str:
    if row is None or "refused" in row:
        return "–"
    share = 100 * row["violation_rate"]
    return f"{share:.{int(0 < share < 10)}f}"


@dataclass(frozen=True)
class Question:
    """Does what `row` has and `paired` lacks change a number?"""

    row: Row
    paired: Row


_CLONE, _SHIELDED, _ADAPTED, _FULL = (("bc", f"default{guard}") for guard in ("", SHIELD, ADAPT, FULL))
FROM_NOTHING: Row = ("mpc", f"default{FULL}")  # MPC from a zero proposal, on robots near rest
ANYWHERE: Row = ("mpc", f"default{FULL}+trust_radius2.0")
QUESTIONS = (
    Question(_SHIELDED, _CLONE),
    Question(_SHIELDED, ("bc", "default+shield-analytic")),
    Question(_FULL, _SHIELDED),
    Question(_FULL, FROM_NOTHING),
)
OF_ROBOTS = (
    Question(_ADAPTED, _CLONE),
    Question(_ADAPTED, ("bc", "default+adapt-analytic")),
    Question(_FULL, _ADAPTED),
    Question(("bc-return", f"default{ADAPT}"), _ADAPTED),
    Question(_FULL, FROM_NOTHING),
    Question(_FULL, ANYWHERE),
)
# By suite: what is asked, and of which cost; no robot starts above the limit.
ASKED = {"guards": (QUESTIONS, "cost_safe_start"), "guards-mujoco": (OF_ROBOTS, "cost")}


@functools.cache
def answers(suite: str) -> list[tuple[Question, str, list[Difference]]]:
    """(question, key, difference on every task that has both rows); p-values adjusted over all of them together."""
    asked, cost = ASKED[suite]
    found = []
    for q in asked:
        for key in ("return", cost):
            each = (difference(suite, t, variant(t, q.row), variant(t, q.paired), key) for t in tasks_of(suite))
            found.append((q, key, [d for d in each if d]))
    adjusted = iter(family([d for *_, ds in found for d in ds]))
    return [(q, key, [next(adjusted) for _ in ds]) for q, key, ds in found]


TABLES: dict[tuple[str, str], Callable[[], str]] = {
    ("docs/results.md", "crossed"): crossed,
    ("docs/results.md", "robots"): robots,
    ("docs/results.md", "crossing"): crossing,
    ("docs/proving-ground.md", "proving"): proving,
}
