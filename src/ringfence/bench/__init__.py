"""The benchmark grid task × algorithm × seed: resumable cells, run locally or on Ray, and the table made of them."""

from ringfence.bench.cells import Cell, Grid, make_grid
from ringfence.bench.local import run_local
from ringfence.bench.packed import pack, unpack
from ringfence.bench.suites import SUITES, Entry, Suite
from ringfence.bench.table import rows, write_csv

__all__ = ["SUITES", "Cell", "Entry", "Grid", "Suite", "make_grid", "pack", "rows", "run_local", "unpack", "write_csv"]
