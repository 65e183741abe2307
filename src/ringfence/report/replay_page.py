"""What a replay found, on one page that needs nothing but itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from markupsafe import Markup
from matplotlib.patches import Circle

from ringfence.evaluation.replay.result import Film, ReplayResult
from ringfence.report import html
from ringfence.report.figures import INK, Drawn, figure, style, to_svg

BEYOND = 2.0  # m around the driven agent that are shown


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
