"""The clock of a table's rows: how long a step is, and rows whose clock drifts or begins late put on whole steps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ringfence.errors import UserError
from ringfence.logs.io.rows import Rows
from ringfence.logs.io.table_schema import TableSchema

GAP = 5.0  # steps without a row that end an episode
EXACT = 0.05  # of a step, by which a round number of seconds or hertz may be off at a recording's end
DIGITS = 1e-5  # of a step, which six digits leave open
CLOSE = 0.01  # of a step, within which another is meant to be the same
NEAR = 10  # rows before and after, whose phase is one
COHERENT = 0.3  # length of the mean phase of rows that share a clock, nearly everywhere; 0 of rows at random times
SLIPS = 0.25  # of a step, above which rows are put on whole steps
OFF = 0.01  # of a step, above which it is said


@dataclass(frozen=True)
class Clock:
    """Steps that rows are put on."""

    dt: float  # s
    gap: float  # s without a row, after which an agent was away


def clock_of(rows: Rows, schema: TableSchema) -> Clock:
    """The steps that the schema asks for, or those of the rows."""
    dt = schema.dt or _step(rows)
    gap = schema.gap or GAP * max(dt, rows.step)
    if gap < rows.step:
        raise UserError(
            f"gap={gap:g} is less than the {rows.step:g} s between an agent's rows; every row would be cut off."
        )
    return Clock(dt, gap)


def _step(rows: Rows) -> float:
    """s between an agent's rows: the median with six digits, or what is near whole hertz, where nothing slips by that
    until the longest recording ends; else the mean over whole numbers of steps, which the digits of no time blur."""
    track = np.cumsum(np.append(True, ~rows.follows))
    lag = min(NEAR, int(np.bincount(track).max()) - 1)
    passed = (rows.time[lag:] - rows.time[:-lag])[track[lag:] == track[:-lag]]
    passed = passed[passed <= GAP * lag * rows.step]
    mean = rows.step
    for _ in range(3):  # a better one counts better
        mean = float(passed.sum() / max(np.round(passed / mean).sum(), 1))
    if abs(mean / rows.step - 1) > CLOSE:  # no clock
        return float(f"{rows.step:.6g}")
    hertz = 1 / max(round(1 / mean), 1)
    nice = [float(f"{rows.step:.6g}"), hertz, float(f"{mean:.6g}")]
    if abs(hertz / rows.step - 1) < DIGITS:
        nice.insert(0, hertz)
    longest = float(_spans(rows).max())
    return next((step for step in nice if abs(step / mean - 1) * longest <= EXACT * step), mean)


def _spans(rows: Rows) -> np.ndarray:
    """(recordings,) s from the first row to the last."""
    begins = np.flatnonzero(np.diff(rows.recording, prepend=-1))
    return np.maximum.reduceat(rows.time, begins) - np.minimum.reduceat(rows.time, begins)


# --- drift ---
def on_whole_steps(rows: Rows, clock: Clock) -> tuple[Rows, list[str]]:
    """The rows with times from 0 in each recording. Where a clock drifts or its first row comes late, so that rows
    would slip by more than a quarter of a step, steps are counted by rows, and a sentence says how far it drifted."""
    spacing = _spacing(clock.dt, rows.step)
    time = rows.time.copy()
    begins = np.flatnonzero(np.diff(rows.recording, prepend=-1))
    furthest = 0.0
    for here in (slice(*ends) for ends in zip(begins, [*begins[1:], len(time)])):
        time[here] -= time[here].min()
        steps = time[here] / clock.dt
        if spacing is None or float(np.abs(steps - np.round(steps)).max()) <= SLIPS:
            continue
        slip = _slip(time[here], rows.agent[here], spacing)
        if slip is not None and float(np.abs(slip).max()) * spacing > SLIPS * clock.dt:
            furthest = max(furthest, float(np.ptp(slip)) * spacing / clock.dt)
            time[here] = np.where(time[here] == 0, 0, time[here] - slip * spacing)
    said = f"a clock drifts by up to {furthest:.3g} steps of {clock.dt:g} s: steps are counted by rows"
    return replace(rows, time=time), [said] if furthest > SLIPS else []


def _spacing(dt: float, step: float) -> float | None:
    """s between rows of which `dt` is a whole number, or a whole part of one: what is near the rows' own `step`."""
    many = round(max(dt / step, step / dt))
    spacing = dt / many if dt >= step else dt * many
    return spacing if abs(spacing / step - 1) < CLOSE else None


def _slip(time: np.ndarray, agent: np.ndarray, spacing: float) -> np.ndarray | None:
    """(M,) rows by which times are late against a clock that ticks from 0 every `spacing` s: of all agents, or of the
    one with most rows where they share no clock. None where that one has none either."""
    for chosen in (np.ones(len(time), bool), agent == np.bincount(agent).argmax()):
        some = np.sort(time[chosen])
        phases = np.concatenate([[0], np.cumsum(np.exp(2j * np.pi / spacing * some))])
        first = np.searchsorted(some, some - NEAR * spacing, "left")
        last = np.searchsorted(some, some + NEAR * spacing, "right")
        mean = (phases[last] - phases[first]) / (last - first)
        if float(np.quantile(np.abs(mean), 0.05)) > COHERENT:
            return np.interp(time, some, np.unwrap(np.angle(mean)) / (2 * np.pi))
    return None


def off_the_clock(rows: Rows, clock: Clock) -> Iterator[str]:
    """A sentence where rows whose times begin at 0 are off the steps."""
    steps = rows.time / clock.dt
    far = float(np.quantile(np.abs(steps - np.round(steps)), 0.99))
    if far > OFF:
        yield (
            f"rows are up to {far:.2g} of a step of {clock.dt:g} s off the clock: states are interpolated, actions, "
            "costs and rewards are those nearest to a step"
        )
