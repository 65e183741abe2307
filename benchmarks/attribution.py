"""Writes docs/attribution.md's tables between their markers, from results/ alone: proposals crossed with guards, and
every question beside its paired baseline.

python benchmarks/attribution.py
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from evidence import Difference, Row, difference, family, mean, of, tasks_of, variant
from readme import put

# Rows by guards of before. There are more seeds of them, and no guard changes what a proposal does alone.
ALONE, GUARDED = "guards-before", "guards"
# Proposals that the page shows: their words, and their row without a guard. `ringfence bench results
# results/guards` prints all others, too.
PROPOSALS: dict[str, Row] = {
    "logs": ("behaviour data", "reference"),
    "do nothing": ("do-nothing", "reference"),
    "BC": ("bc", "default"),
    "10 % BC": ("bc-best", "default"),
    "return-conditioned BC": ("bc-return", "default"),
    "MA-TD3+BC": ("ma-td3bc", "default"),
    "MA-TD3+BC, Lagrange": ("ma-td3bc-lag", "default"),
    "OMAR": ("omar", "default"),
}
# The same under other guards.
OTHERS: dict[str, Row] = {
    "BC, `full`": ("bc", "default+full-learned"),
    "MPC from a zero proposal (`mpc`), `full`": ("mpc", "default+full-learned"),
}


@dataclass(frozen=True)
class Question:
    """Does what `row` has and `paired` lacks change `key`?"""

    words: str
    row: Row
    paired: Row
    keys: tuple[str, ...] = ("return", "cost_safe_start")
    shown: bool = True  # on the page
    suite: str = ""  # another one than that of the other questions, e.g. of more seeds where nobody is guarded


SHIELD, FULL = "+shield-learned", "+full-learned"
ROBOT_KEYS = ("return", "cost")  # nobody starts above the limit
QUESTIONS = (
    Question("a shield, under BC", ("bc", f"default{SHIELD}"), ("bc", "default")),
    Question(
        "danger learned, not the formula, in that shield",
        ("bc", f"default{SHIELD}"),
        ("bc", "default+shield-analytic"),
    ),
    Question("`full`, not the shield alone", ("bc", f"default{FULL}"), ("bc", f"default{SHIELD}")),
    Question("BC under `full`, not MPC from a zero proposal", ("bc", f"default{FULL}"), ("mpc", f"default{FULL}")),
)

ADAPT = "+adapt-learned"
OF_ROBOTS = (
    Question("a guard (`adapt`), under BC", ("bc", f"default{ADAPT}"), ("bc", "default"), ROBOT_KEYS),
    Question(
        "danger learned, not the formula", ("bc", f"default{ADAPT}"), ("bc", "default+adapt-analytic"), ROBOT_KEYS
    ),
    Question("`full`, not `adapt`", ("bc", f"default{FULL}"), ("bc", f"default{ADAPT}"), ROBOT_KEYS),
    Question(
        "return-conditioned BC, not BC",
        ("bc-return", f"default{ADAPT}"),
        ("bc", f"default{ADAPT}"),
        ROBOT_KEYS,
        shown=False,
    ),
    *(
        Question(f"{words}, not BC", (name, f"default{ADAPT}"), ("bc", f"default{ADAPT}"), ROBOT_KEYS, shown=False)
        for words, name in (("10 % BC", "bc-best"), ("MA-TD3+BC", "ma-td3bc"), ("OMAR", "omar"))
    ),
    *(
        Question(
            f"BC under `full`, not MPC from a zero proposal ({where})",
            ("bc", f"default{FULL}"),
            ("mpc", f"default{FULL}{reach}"),
            ROBOT_KEYS,
        )
        for where, reach in (("near rest", ""), ("climbed anywhere", "+trust_radius2.0"))
    ),
)


def main() -> None:
    put("docs/attribution.md", "crossed", crossed(GUARDED))
    put("docs/attribution.md", "questions", questions(GUARDED))
    put("docs/attribution.md", "robots", robots("guards-mujoco"))
    put("docs/attribution.md", "robot-questions", counted("guards-mujoco"))


def cell(suite: str, task: str, row: Row, keys: tuple[str, str], digits: tuple[int, int]) -> tuple[str, int]:
    """Two means of a row on a task, as words, and of how many seeds."""
    here = variant(task, row)
    means = [(mean(suite, task, here, key), n) for key, n in zip(keys, digits)]
    words = "–" if means[0][0] is None else " / ".join(f"{value:z.{n}f}" for value, n in means)
    return words, len(of(suite, task, here))


def crossed(suite: str) -> str:
    """A line per proposal, a column per task: normalised return / cost of resets that start safely → return under a
    shield, whose cost the page gives."""
    names, lines = tasks_of(suite), []
    for words, row in (PROPOSALS | OTHERS).items():
        cells = []
        for task in names:
            text, seeds = cell(suite, task, row, ("return_norm", "cost_safe_start"), (2, 2))
            guarded = mean(suite, task, variant(task, (row[0], row[1] + SHIELD)), "return_norm")
            text += f" → {guarded:z.2f}" if guarded is not None else ""
            cells.append((text, seeds if row[1] != "reference" else 0))
        lines.append((words, cells))
    usual = [_usual([cells[i][1] for _, cells in lines]) for i in range(len(names))]
    heads = [f"{name.partition('-')[2]} [{seeds}]" for name, seeds in zip(names, usual)]
    out = ["| proposal | " + " | ".join(heads) + " |", "|---" * (1 + len(names)) + "|"]
    for words, cells in lines:
        marked = [text + (f" [{n}]" if n and n != seeds else "") for (text, n), seeds in zip(cells, usual)]
        out.append("| " + " | ".join([words, *marked]) + " |")
    return "\n".join([*out, "", "[n]: of n seeds, but where a cell says another number."])


def _usual(counts: list[int]) -> int:
    """The most common number of seeds."""
    return Counter(n for n in counts if n).most_common(1)[0][0]


# Robots' proposals under `adapt`, danger learned, and the one that only climbs: their words and rows. Cloning under
# `full` stands in docs/guard-results.md.
ROBOTS: dict[str, Row] = {
    "BC": ("bc", f"default{ADAPT}"),
    "return-conditioned BC": ("bc-return", f"default{ADAPT}"),
    "MPC, `full`": ("mpc", f"default{FULL}"),
    "MPC, `full`, anywhere": ("mpc", f"default{FULL}+trust_radius2.0"),
}


def robots(suite: str) -> str:
    """A line per proposal, a column per data set under the limit that proposals were played with: return / steps above
    it."""
    names = [t for t in tasks_of(suite) if of(suite, t, variant(t, ROBOTS["return-conditioned BC"]))]
    out = ["| | " + " | ".join(names) + " |", "|---" * (1 + len(names)) + "|"]
    for words, row in ROBOTS.items():
        made = [cell(suite, task, row, ("return_mean", "cost_mean"), (0, 1)) for task in names]
        usual = _usual([seeds for _, seeds in made])
        cells = [text + (f" [{seeds}]" if seeds not in (0, usual) else "") for text, seeds in made]
        out.append(f"| {words} [{usual}] | " + " | ".join(cells) + " |")
    return "\n".join([*out, "", "[n]: of n seeds, but where a cell says another number."])


def answers(suite: str, asked: tuple[Question, ...] = QUESTIONS) -> list[tuple[Question, str, list[Difference]]]:
    """(question, key, difference on every task that has both rows); p-values adjusted over all of them together."""
    found = [
        (
            q,
            key,
            [
                d
                for t in tasks_of(suite)
                if (d := difference(q.suite or suite, t, variant(t, q.row), variant(t, q.paired), key))
            ],
        )
        for q in asked
        for key in q.keys
    ]
    adjusted = iter(family([d for *_, ds in found for d in ds]))
    return [(q, key, [next(adjusted) for _ in ds]) for q, key, ds in found]


def questions(suite: str) -> str:
    """A line per question and number: the difference on every task, bold where it is significant. Costs that differ
    nowhere are left out."""
    names = tasks_of(suite)
    out = ["| what differs | of | " + " | ".join(n.partition("-")[2] for n in names) + " |"]
    out.append("|---" * (2 + len(names)) + "|")
    for q, key, ds in answers(suite):
        if not q.shown or not ds or (key != "return" and not any(d.holds for d in ds)):
            continue
        by_task = {d.task: d for d in ds}
        cells = [shown(by_task[n], key) if n in by_task else "–" for n in names]
        out.append(f"| {q.words} | {'return' if key == 'return' else 'cost'} | " + " | ".join(cells) + " |")
    return "\n".join(out)


def counted(suite: str) -> str:
    """A line per question of robots: on how many tasks the row has more and less, beyond chance, and which they are.
    What differs nowhere is left out."""
    out = ["| what differs | of | tasks | seeds | more on | less on |", "|---" * 6 + "|"]
    for q, key, ds in answers(suite, OF_ROBOTS):
        if not q.shown or not ds or not any(d.holds for d in ds):
            continue
        sides = [[f"`{d.task}` {d.mean:+.3g}" for d in ds if d.holds and d.mean * sign > 0] for sign in (1, -1)]
        listed = [f": {', '.join(side)}" if len(side) <= 3 else "" for side in sides]
        counts = [f"**{len(side)}**{names}" if side else "0" for side, names in zip(sides, listed)]
        seeds = sorted({len(d.seeds) for d in ds})
        some = "–".join(map(str, dict.fromkeys((seeds[0], seeds[-1]))))
        out.append(f"| {q.words} | {key} | {len(ds)} | {some} | {counts[0]} | {counts[1]} |")
    return "\n".join(out)


def shown(d: Difference, key: str) -> str:
    digits = 0 if key == "return" else 2
    text = f"{d.mean:+.{digits}f} [{d.low:.{digits}f}, {d.high:.{digits}f}]"
    return f"**{text}**" if d.holds else text


if __name__ == "__main__":
    main()
