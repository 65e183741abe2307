"""What logs alone say, on pages that need nothing but themselves: a World's card, a policy by logs, and replays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.colors import TwoSlopeNorm
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator

from ringfence.datasets.audit import Audit
from ringfence.evaluation.ope_result import OPEResult, Safety
from ringfence.evaluation.replay import Film, ReplayResult
from ringfence.report import html
from ringfence.report.figures import INK, Drawn, figure, style, to_svg
from ringfence.world import Card
from ringfence.world.card import BarrierScores, Probe, ProbeMap

# What is said of each rate of what a policy does.
BEHAVIOUR = {
    "intervention_rate": "states in which the guard changes the action",
    "infeasible_rate": "states in which it cannot do what it should",
    "guard_ood_rate": "states that are out of distribution for the guard's World",
    "ood_rate": "states in which the action leads out of the distribution of these logs",
}
SIZE = (3.5, 2.5)  # inches
MARGINS = 4.0  # that are shown on both sides of 0
BEYOND = 2.0  # m around the driven agent that are shown


def build_ope(out: str | Path, card: Card, audit: Audit, result: OPEResult | None = None) -> Path:
    """Write the page of logs and their World, and of a policy that was evaluated by them (`ringfence.ope`)."""
    title = f"{card.data.task}: what its logs say"
    if result is not None:
        title += f" of {result.algorithm}"
    rates = [] if result is None else [(said, getattr(result.behaviour, name)) for name, said in BEHAVIOUR.items()]
    text = html.render(
        "ope.html.j2",
        {
            "title": title,
            "facts": audit.facts.items(),
            "warnings": [*audit.warnings, *audit.notes],
            "words": str(card).splitlines(),
            "figures": _figures(card, result),
            "probes": panels(card),
            "ope": result,
            "behaviour": [(said, rate) for said, rate in rates if rate is not None],
        },
    )
    return html.write(Path(out), text)


def _figures(card: Card, result: OPEResult | None) -> list[Drawn]:
    drawn = []
    barrier = card.barrier
    if barrier is not None and barrier.calibration:
        said = f"Dashed: the default margin, {barrier.margin:.2g}. Held-out steps, as often unsafe as in the logs."
        drawn.append(Drawn("What a margin means", _calibration(barrier), said))
    if result is not None and result.safety is not None:
        said = (
            "The share of safe logged states whose smallest predicted margin is below a value. Below 0: danger is "
            "predicted. Below 1: the calibrated margin is not kept."
        )
        title = f"Margins predicted along {result.ahead} steps"
        drawn.append(Drawn(title, _margins(result.safety), said))
    return drawn


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


def panels(card: Card) -> list[Drawn]:
    """A picture of every probe on a card, by constraint where the logs name several."""
    drawn = []
    each = card.constraints or ({"": card.barrier} if card.barrier else {})
    for k, (constraint, scores) in enumerate(each.items()):
        of = f" (‘{constraint}’)" if constraint else ""
        for j, probe in enumerate(sorted(scores.probes, key=lambda probe: not probe.unsafe)):
            draw = _neighbour if probe.unsafe else _curve
            drawn.append(draw(probe, f"{_subject(probe.name)}{of}", f"probe{k}-{j}"))
        for j, plane in enumerate(scores.maps):
            drawn.append(_map(plane, f"{_subject(plane.name)}{of}", f"probe{k}-map{j}"))
    return drawn


def _subject(name: str) -> str:
    return name.removesuffix(", put into held-out states")


def _neighbour(probe: Probe, subject: str, name: str) -> Drawn:
    """Share of states that are called unsafe, by how near something is put."""
    title = f"Called unsafe by {subject}"
    lines = {"at rest": (probe.unsafe, "-", "o")}
    if probe.unsafe_closing:
        lines["closing in"] = (probe.unsafe_closing, "--", "s")
    with style(font_size=9):
        made = figure(*SIZE)
        ax = made.add_subplot()
        for label, (share, line, marker) in lines.items():
            ax.plot(probe.at, 100 * np.array(share), color=INK, linestyle=line, marker=marker, ms=4, label=label)
        _begins(ax, probe.edge)
        ax.set_ylim(-4, 104)
        ax.set_xlim(left=0)
        ax.set_xlabel("distance")
        ax.set_ylabel("called unsafe, %")
        ax.legend(frameon=False)
        svg = to_svg(made, title, name)
    said = "Held-out states with it put at a quarter to twice the radius that these logs tell"
    return Drawn(title, svg, f"{said} ({_said(probe.edge)}, dotted).")


def _curve(probe: Probe, subject: str, name: str) -> Drawn:
    """Scores along one number."""
    title = f"Score along {subject}"
    with style(font_size=9):
        made = figure(*SIZE)
        ax = made.add_subplot()
        ax.plot(probe.at, np.clip(probe.scores, -MARGINS, MARGINS), color=INK)
        ax.axhspan(-MARGINS, 0, color=INK, alpha=0.07, linewidth=0)
        _begins(ax, probe.edge)
        ax.set_ylim(-1.05 * MARGINS, 1.05 * MARGINS)
        ax.set_xlabel(subject.split(" (")[0])
        ax.set_ylabel("score, in margins")
        svg = to_svg(made, title, name)
    begins = "Danger begins nowhere here." if np.isnan(probe.edge) else f"Dotted: danger begins at {_said(probe.edge)}."
    return Drawn(title, svg, f"Shaded: called unsafe. {begins}")


def _said(value: float) -> str:
    return f"{value:.3g}".replace("-", "−")


def _begins(ax: Axes, edge: float) -> None:
    """Where danger begins, as a line."""
    if not np.isnan(edge):
        ax.axvline(edge, color=INK, linewidth=1.0, linestyle=(0, (1, 2)))


def _map(plane: ProbeMap, subject: str, name: str) -> Drawn:
    """Scores over a plane."""
    title = f"Score over {subject}"
    scores = np.clip(plane.scores, -MARGINS, MARGINS)
    entries = _subject(plane.name).split(", ", 1)
    half_x, half_y = (0.5 * (axis[1] - axis[0]) for axis in (plane.x, plane.y))
    extent = (plane.x[0] - half_x, plane.x[-1] + half_x, plane.y[0] - half_y, plane.y[-1] + half_y)
    with style(font_size=9, axes_grid=False):
        made = figure(SIZE[0], SIZE[1] + 0.5)
        ax = made.add_subplot()
        norm = TwoSlopeNorm(0.0, -MARGINS, MARGINS)
        image = ax.imshow(scores, origin="lower", extent=extent, cmap="RdBu", norm=norm, aspect="auto")
        if scores.min() < 0 < scores.max():
            ax.contour(plane.x, plane.y, scores, [0.0], colors="black", linewidths=1.2)
        ax.set_xlabel(entries[0])
        ax.set_ylabel(entries[-1])
        ax.xaxis.set_major_locator(MaxNLocator(5))
        made.colorbar(image, ax=ax).set_label("score, in margins")
        svg = to_svg(made, title, name)
    return Drawn(title, svg, f"Red: called unsafe, {100 * float((scores < 0).mean()):.0f} % of this plane.")


def build_replay(out: str | Path, result: ReplayResult) -> Path:
    """Write the page of a replay."""
    drawn = [Drawn(film.title, _drawn(film, result.radius, k)) for k, film in enumerate(result.films)]
    title = f"{result.task}: one agent driven, the others as logged"
    return html.write(Path(out), html.render("replay.html.j2", {"title": title, "result": result, "films": drawn}))


def _drawn(film: Film, radius: float, number: int) -> Markup:
    """Paths of the driven agent without guard, with it and as logged, among the others'."""
    own = np.concatenate([film.logged, film.alone, film.guarded])[:, :2]  # from above
    low, high = own.min(0) - BEYOND, own.max(0) + BEYOND
    with style():
        made = figure(8.2, 4.6)
        ax = made.add_subplot()
        for other in np.moveaxis(film.others[..., :2], 1, 0):
            there = ((other > low) & (other < high)).all(-1)
            shown = np.where(there[:, None], other, np.nan)
            # Dots and no line: where others are listed by distance, a place in the list may change its owner.
            ax.plot(*shown.T, color=INK, linestyle="none", alpha=0.45, marker=".", markersize=4)
        lines = {
            "as logged": (film.logged, (0, (1, 2))),
            "without guard": (film.alone, (0, (4, 2))),
            "with guard": (film.guarded, "-"),
        }
        for name, (path, line) in lines.items():
            ax.plot(*path[:, :2].T, color=INK, linewidth=1.6, linestyle=line, label=name)
            if path is film.logged:
                continue
            nearest = np.linalg.norm(film.others - path[:, None], axis=-1).min(-1).argmin()
            around = Circle(tuple(path[nearest, :2]), radius, fill=False, color=INK, linewidth=0.8, linestyle=line)
            ax.add_patch(around)  # contact, where it was nearest to another
        ax.set_xlim(low[0], high[0])
        ax.set_ylim(low[1], high[1])
        ax.set_aspect("equal")
        ax.set_xlabel("m")
        ax.legend(frameon=False)
        return to_svg(made, film.title, f"window{number}")
