"""What a barrier answers when it is asked, as small pictures: neighbours, speeds, places."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import TwoSlopeNorm
from matplotlib.ticker import MaxNLocator

from ringfence.report.figures import INK, Drawn, figure, style, to_svg
from ringfence.world import Card
from ringfence.world.card import BarrierScores, Probe, ProbeMap

SIZE = (3.5, 2.5)  # inches
MARGINS = 4.0  # that are shown on both sides of 0


def panels(card: Card) -> list[Drawn]:
    """A picture of every probe on a card, by constraint where the logs name several."""
    each = card.constraints or ({"": card.barrier} if card.barrier else {})
    return [drawn for k, (name, scores) in enumerate(each.items()) for drawn in _of(scores, name, f"probe{k}")]


def _of(scores: BarrierScores, constraint: str, prefix: str) -> Iterator[Drawn]:
    of = f" (‘{constraint}’)" if constraint else ""
    for k, probe in enumerate(sorted(scores.probes, key=lambda probe: not probe.unsafe)):
        draw = _neighbour if probe.unsafe else _curve
        yield draw(probe, f"{_subject(probe.name)}{of}", f"{prefix}-{k}")
    for k, plane in enumerate(scores.maps):
        yield _map(plane, f"{_subject(plane.name)}{of}", f"{prefix}-map{k}")


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
