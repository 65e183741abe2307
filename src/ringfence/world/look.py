"""How far guards look by themselves: decided of a World when it is fitted, by how well it predicts."""

from __future__ import annotations

from ringfence.world.card import FARTHEST, JUDGED, Avoidable, BarrierScores, Card, Foresight, Look

LITTLE = 0.9  # of what could be avoided: where the judged rows avoid less, V sees in time what they do not
BEARABLE = 0.3  # error of predictions as a share of what changes, or of what is read, up to which more rows count
KEPT = 0.9  # of the safe steps: cars and discs are at 0.94 and more, robots, whose logs are too fast, at 0 to 0.8


def look_of(card: Card) -> Look:
    """What a guard is to look at, where a World is as its card says."""
    rows = _rows_foreseen_well(card)
    scores = card.barrier
    if scores is None or scores.avoidable is None or not _too_late(scores.avoidable):
        return Look(rows)
    error = card.prediction_error
    if error is not None and error.error_of_change[-1] <= BEARABLE:
        return Look(rows, avoiding=min(scores.avoidable.rows, FARTHEST))
    return Look(rows, terminal_value=scores.ahead_kept >= KEPT)


def _rows_foreseen_well(card: Card) -> int:
    """Rows, FARTHEST at most, for which all that the barrier reads is predicted well; margins widen along them."""
    read = () if card.prediction_error is None else card.prediction_error.read
    if not read or card.barrier is None or not _widens(card, card.barrier):
        return 0
    steps = [k for at, k in enumerate(read[0].steps_ahead) if all(_is_foreseen(one, at) for one in read)]
    return min(max(steps, default=0), FARTHEST)


def _is_foreseen(one: Foresight, at: int) -> bool:
    return one.error[at] <= BEARABLE * one.deviation


def _widens(card: Card, scores: BarrierScores) -> bool:
    """Whether the World says what rows ahead ask for; those of before do not."""
    return all(one.widening for one in (card.constraints or {"": scores}).values())


def _too_late(avoidable: Avoidable) -> bool:
    """Whether the rows that a guard judges avoid little of the danger that could have been avoided, e.g. where braking
    takes longer."""
    seen = [share for before, share in zip(avoidable.before, avoidable.avoided) if before <= JUDGED]
    return max(seen, default=0.0) < LITTLE * max(avoidable.avoided)
