"""Logs of places on a map: a naive driver and a clone, alone and under a shield, by a World that reads how far away
others and things are, and by one that reads their entries as they are. Systems are those of _mapped.py.

    python benchmarks/on_map.py                    # of all; ten minutes a system
    python benchmarks/on_map.py posts --seed 14    # of some, by other logs
    python benchmarks/on_map.py --table            # of results/on_map.csv, into docs/proving-ground.md

Rows that are in results/on_map.csv already are not made again.
"""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest import mock

from _mapped import Alone, Listed, Mapped, Posts, Stated, Unnamed, Walkers
from _paired import Pair

from ringfence.problem import on_map
from ringfence.problem.inferred_names import inferred_names

OUT = Path(__file__).resolve().parent.parent / "results" / "on_map.csv"
SYSTEMS = (Mapped, Unnamed, Alone, Stated, Listed, Posts, Walkers)
NAMED = {cls.__name__.lower(): cls for cls in SYSTEMS}


@contextmanager
def as_they_are():
    """Features as they would be if places on a map were left as they are."""

    def columns(observations, names, joined=None, first_rows=None, keep=()):
        seen = on_map.Columns.as_seen(observations.shape[1], names)
        return replace(seen, names=inferred_names(observations, names, first_rows, keep))

    with mock.patch.object(on_map, "relative", columns):
        yield


PAIR = Pair(OUT, "how far away", "places as they are", as_they_are)


if __name__ == "__main__":
    PAIR.main(str(__doc__), NAMED, 13, ("mapped", "on-map"))
