"""What the robots' rows say of the goal: adaptive `split` is within the limit, earns what the data's safe part earns,
and costs less than every baseline that earns about as much.

python benchmarks/goal.py
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from ringfence.report import board, standings
from ringfence.report.standings import Standing

RESULTS = Path(__file__).resolve().parent.parent / "results" / "mujoco"
SHARE = 0.8  # of our return: who earns less is no rival
HEAD = (
    "`split`, adaptive",
    "its cost's 95 % interval",
    "data within the limit",
    f"cheapest baseline with {100 * SHARE:.0f} % of its return",
    "most return within the limit",
)


def table(folder: Path = RESULTS) -> str:
    """One line per task; return / steps above the limit."""
    shown = board.read(folder)
    references, reached_on, first, pairs = standings.references(shown), [], Counter(), []
    lines = ["| task | " + " | ".join(HEAD) + " |", "|---" * (len(HEAD) + 1) + "|"]
    for task, rows in standings.standings(shown).items():
        ours = next((r for r in rows if _is(r, "icbf", "adaptive")), None)
        if ours is None:
            continue
        pairs += [(ours, r) for r in rows if _is(r, "madiff", "adaptive")]
        logged = next((r for r in references[task] if r.name == "data within the limit"), None)
        rivals = [r for r in rows if _baseline(r) and r.returns >= SHARE * ours.returns]
        rival = min(rivals, key=lambda r: (r.cost, -r.returns), default=None)
        best = next((r for r in rows if r.best), None)
        beaten = rival is None or ours.cost < rival.cost
        reached = (ours.safe, logged is None or ours.returns >= logged.returns, beaten)
        low, high = ours.cost_interval
        cells = (
            _numbers(ours),
            f"{low:.1f} to {high:.1f}",
            "none" if logged is None else _numbers(logged),
            "none" if rival is None else f"{_name(rival)} {_numbers(rival)}",
            "none" if best is None else f"{_name(best)} {_numbers(best)}",
        )
        marked = [f"{c} ✗" if not ok else c for c, ok in zip(cells[1:4], reached)]
        lines.append("| " + " | ".join((task, cells[0], *marked, cells[4])) + " |")
        reached_on.append(reached)
        first.update([_family(best)] if best else [])
    within, matched, cheaper = (sum(column) for column in zip(*reached_on))
    lines.append(
        f"\n✗: not reached. Of {len(reached_on)} tasks the interval is within the limit on {within}, the return is at "
        f"least that of the data within the limit on {matched} (or there is no such data), and the cost is below that "
        f"of every baseline with {100 * SHARE:.0f} % of the return on {cheaper}. Most return within the limit: "
        + ", ".join(f"{name} on {n}" for name, n in first.most_common())
        + "."
    )
    lines.append(f"\n{_against(pairs)}")
    return "\n".join(lines)


def _against(pairs: list[tuple[Standing, Standing]]) -> str:
    """What the barrier adds: ours and MADIFF under the same planner."""
    kept, ends = sum(other.safe for _, other in pairs), max(other.cost_interval[1] for _, other in pairs)
    costs = [ours.cost - other.cost for ours, other in pairs]
    earned = [100 * (ours.returns / other.returns - 1) for ours, other in pairs]  # %
    less, more = (lambda x: sum(d < 0 for d in x)), (lambda x: sum(d > 0 for d in x))
    return (
        f"MADIFF, which has no barrier, keeps the limit with the same planner on {kept} of {len(pairs)} (its intervals "
        f"end at {ends:.1f} at most). Beside it `split` costs less on {less(costs)} and more on {more(costs)}, between "
        f"{-min(costs):.1f} steps less and {max(costs):.1f} more, and earns more on {more(earned)} and less on "
        f"{less(earned)}, between {max(earned):.0f} % more and {-min(earned):.0f} % less."
    )


def _is(row: Standing, algorithm: str, planner: str) -> bool:
    return row.method.algorithm == algorithm and row.method.preset == "default" and row.method.shown == planner


def _baseline(row: Standing) -> bool:
    """As published: none of the planners that were added here."""
    return row.method.algorithm != "icbf" and not row.method.shown


def _family(row: Standing) -> str:
    return "`split`" if row.method.algorithm == "icbf" else row.name.removesuffix(" (no barrier)")


def _name(row: Standing) -> str:
    return f"{_family(row)}, {row.method.shown}" if row.method.shown else _family(row)


def _numbers(row: Standing) -> str:
    cost = f"{row.cost:.1f}" if row.cost >= 0.05 or row.cost == 0 else "< 0.05"
    return f"{row.returns:.0f} / {cost}"


if __name__ == "__main__":
    print(table())
