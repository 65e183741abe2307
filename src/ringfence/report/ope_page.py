"""A World's card, and what logs say of a policy, on one page that needs nothing but itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from markupsafe import Markup

from ringfence.datasets.audit import Audit
from ringfence.evaluation.ope.result import Behaviour, OPEResult, Safety
from ringfence.report import html, probes
from ringfence.report.figures import INK, Drawn, figure, style, to_svg
from ringfence.world import Card
from ringfence.world.card import BarrierScores

# What is said of each rate of what a policy does.
BEHAVIOUR = {
    "intervention_rate": "states in which the guard changes the action",
    "infeasible_rate": "states in which it cannot do what it should",
    "guard_ood_rate": "states that are out of distribution for the guard's World",
    "ood_rate": "states in which the action leads out of the distribution of these logs",
}


def build_ope(out: str | Path, card: Card, audit: Audit, result: OPEResult | None = None) -> Path:
    """Write the page of logs and their World, and of a policy that was evaluated by them (`ringfence.ope`)."""
    title = f"{card.data.task}: what its logs say"
    if result is not None:
        title += f" of {result.algorithm}"
    text = html.render(
        "ope.html.j2",
        {
            "title": title,
            "facts": audit.facts.items(),
            "warnings": [*audit.warnings, *audit.notes],
            "words": str(card).splitlines(),
            "figures": _figures(card, result),
            "probes": probes.panels(card),
            "ope": result,
            "behaviour": [] if result is None else _rates(result.behaviour),
        },
    )
    return html.write(Path(out), text)


def _figures(card: Card, result: OPEResult | None) -> list[Drawn]:
    drawn = []
    barrier = card.barrier
    if barrier is not None and barrier.calibration:
        drawn.append(Drawn("What a margin means", _calibration(barrier), _said_of(barrier)))
    if result is not None and result.safety is not None:
        said = (
            "The share of safe logged states whose smallest predicted margin is below a value. Below 0: danger is "
            "predicted. Below 1: the calibrated margin is not kept."
        )
        title = f"Margins predicted along {result.ahead} steps"
        drawn.append(Drawn(title, _margins(result.safety), said))
    return drawn


def _rates(behaviour: Behaviour) -> list[tuple[str, float]]:
    rates = [(said, getattr(behaviour, name)) for name, said in BEHAVIOUR.items()]
    return [(said, rate) for said, rate in rates if rate is not None]


def _calibration(barrier: BarrierScores) -> Markup:
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


def _margins(safety: Safety) -> Markup:
    lines = {"policy": (safety.margins, "-"), "logs": (safety.margins_of_logs, (0, (4, 2)))}
    with style():
        made = figure(8.2, 3.0)
        ax = made.add_subplot()
        for name, (quantiles, linestyle) in lines.items():
            share = np.linspace(0, 100, len(quantiles))
            ax.plot(np.clip(quantiles, -4, 6), share, color=INK, linestyle=linestyle, label=name)
        ax.axvspan(-4, 0, color=INK, alpha=0.07, linewidth=0)
        ax.axvline(1, color=INK, linewidth=1.0, linestyle=(0, (1, 2)))
        ax.set_xlim(-4, 6)
        ax.set_xlabel("smallest predicted margin, in units of the calibrated one")
        ax.set_ylabel("states below it, %")
        ax.legend(frameon=False)
        return to_svg(made, "Predicted margins of the policy and of the logs", "margins")
