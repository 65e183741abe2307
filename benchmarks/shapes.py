"""Danger that is no distance alone: a naive driver and a clone of the logs, alone and under a shield, by a World whose
causes may read more than that, and by one whose may not. Systems are those of _shaped.py,
_shaped_more.py and _shaped_last.py.

    python benchmarks/shapes.py                    # of all; fifteen minutes a system
    python benchmarks/shapes.py docks --seed 11    # of some, by other logs
    python benchmarks/shapes.py --table            # of results/shapes.csv, into docs/proving-ground.md

Rows that are in results/shapes.csv already are not made again.
"""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from unittest import mock

from _paired import Pair
from _shaped import Docks, Meeting, Sector, Sprayers
from _shaped_last import Downwash, Pickers, Swarm
from _shaped_more import Bikes, Boats, Crowd, Depot, Junction, Persons, Rays
from _system import System

from ringfence.world import cause_candidates, cause_search

ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "results" / "shapes.csv"
SEED = 10
LED = (Sector, Meeting, Docks, Sprayers, Persons, Crowd, Boats, Bikes, Depot, Junction, Rays)
SYSTEMS: tuple[type[System], ...] = (*LED, Downwash, Pickers, Swarm)
NAMED = {cls.__name__.lower(): cls for cls in SYSTEMS}


@contextmanager
def without_more_shapes():
    """The search for causes as it would be without those that read more of how near things are, or rows of entries."""
    plain = mock.patch.object(cause_search, "_with_more_shapes", lambda steps, chosen, names: chosen)
    with plain, mock.patch.object(cause_candidates, "_rows", lambda names: ()):
        yield


PAIR = Pair(OUT, "more shapes", "no more shapes", without_more_shapes)


if __name__ == "__main__":
    PAIR.main(str(__doc__), NAMED, SEED, ("shaped", "shapes"))
