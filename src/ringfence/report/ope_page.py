"""A World's card, and what logs say of a policy, on one page that needs nothing but itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from ringfence.datasets.audit import Audit
from ringfence.report import html
from ringfence.report.figures import INK, figure, style, to_svg
from ringfence.world import Card
from ringfence.world.card import BarrierScores

# What is said of each number of a judgement, and of which kind it is.
CONDUCT = {
    "steps_in": "states in which the guard changes the action",
    "infeasible": "states in which it cannot do what it should",
    "strange": "states in which the guard's World does not know",
    "unknown": "states in which the judging World does not know where the action leads",
}


def build_judgement(out: str | Path, card: Card, audit: Audit, judged: dict[str, Any] | None = None) -> Path:
    """Write the page of logs and their World, and of a policy that was judged by them (`judging.judge`)."""
    drawn = []
    if card.barrier is not None and card.barrier.calibration:
        drawn.append(("What a margin means", _calibration(card.barrier), _said_of(card.barrier)))
    if judged and judged.get("margins"):
        drawn.append(
            (
                f"Margins foreseen along {judged['ahead']} steps",
                _margins(judged["margins"]),
                "The share of safe logged states whose worst foreseen margin is below a value. Below 0: danger is "
                "foreseen. Below 1: not surely safe.",
            )
        )
    words = str(card).splitlines()
    text = html.render(
        "judgement.html.j2",
        {
            "title": f"{card.data.task}: what its logs say" + (f" of {judged['algorithm']}" if judged else ""),
            "facts": audit.facts.items(),
            "warnings": [*audit.warnings, *audit.notes],
            "words": words,
            "figures": [{"title": t, "svg": Markup(svg), "said": said} for t, svg, said in drawn],
            "judged": judged,
            "conduct": [(CONDUCT[k], judged[k]) for k in CONDUCT if judged.get(k) is not None] if judged else [],
        },
    )
    return html.write(Path(out), text)


def _calibration(barrier: BarrierScores) -> str:
    """Unsafe steps in 1000, and safe ones kept, by margin."""
    rows = barrier.calibration
    x = [row.margin for row in rows]
    with style():
        made = figure(8.2, 2.8)
        left, right = made.subplots(1, 2)
        left.plot(x, [row.unsafe_in_1000 for row in rows], marker="o", color=INK)
        left.set_ylabel("unsafe of 1000")
        left.set_ylim(bottom=0)
        right.plot(x, [100 * row.safe_kept for row in rows], marker="o", color=INK)
        right.set_ylabel("safe steps that have it, %")
        right.set_ylim(0, 103)
        for ax in (left, right):
            ax.axvline(barrier.margin, color=INK, linewidth=1.0, linestyle=(0, (3, 3)))
            ax.set_xlabel("margin of a held-out step, or more")
        return to_svg(made, "Unsafe steps and safe steps by margin", "calibration")


def _said_of(barrier: BarrierScores) -> str:
    return f"Dashed: the default margin, {barrier.margin:.2g}. Held-out steps, as often unsafe as in the logs."


def _margins(margins: dict[str, list[float]]) -> str:
    with style():
        made = figure(8.2, 3.0)
        ax = made.add_subplot()
        for k, (name, quantiles) in enumerate(margins.items()):
            share = np.linspace(0, 100, len(quantiles))
            ax.plot(np.clip(quantiles, -4, 6), share, color=INK, linestyle=("-", (0, (4, 2)))[k], label=name)
        ax.axvspan(-4, 0, color=INK, alpha=0.07, linewidth=0)
        ax.axvline(1, color=INK, linewidth=1.0, linestyle=(0, (1, 2)))
        ax.set_xlim(-4, 6)
        ax.set_xlabel("worst foreseen margin, in units of the calibrated one")
        ax.set_ylabel("states below it, %")
        ax.legend(frameon=False)
        return to_svg(made, "Foreseen margins of the policy and of the logs", "margins")
