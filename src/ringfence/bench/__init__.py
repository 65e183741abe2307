"""The benchmark grid task × algorithm × seed: resumable cells, run locally or on Ray, and the table made of them."""

from ringfence.bench.cells import Cell, Grid, collected, make_grid, make_grids
from ringfence.bench.engines import run_local
from ringfence.bench.packed import pack, unpack
from ringfence.bench.suites import COLLECTIONS, SUITES, Entry, Suite
from ringfence.bench.table import rows, write_csv

__all__ = [
    "COLLECTIONS",
    "SUITES",
    "Cell",
    "Entry",
    "Grid",
    "Suite",
    "collected",
    "make_grid",
    "make_grids",
    "pack",
    "rows",
    "run_local",
    "unpack",
    "write_csv",
]
