"""What follows from the card of a World: whether it is fit to guard by, with its reasons and what helps, and how far
guards look by themselves, by how well it predicts."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Literal

from msgspec.structs import replace

from ringfence.errors import UserError
from ringfence.logs.late import Lateness
from ringfence.world.card import FARTHEST, JUDGED, PUT, UNNAMED, Avoidable, BarrierScores, Card, Look, Verdict
from ringfence.world.causes import Found

Word = Literal["fit", "weak", "unfit"]
ENTRIES = (5, 30)  # held-out entries into danger: with fewer than these nothing, or little, is known
RECALL = (0.8, 0.95)  # share of unsafe steps found with 1 false alarm in 100
TOLD = (0.0, 0.8)  # share of unsafe steps that causes tell, where the barrier does not find nearly all by them
NEARLY_ALL = 0.99  # of the unsafe steps
KEPT = (0.2, 0.6)  # share of safe steps that keep the margin: a guard fights most actions below it
FORESEEN = (0.5, 0.95)  # share of entries into danger that are predicted to have less than the margin
AVOIDABLE = (0.0, 0.3)  # share of entries into danger that other actions could have avoided, as it predicts
NOTHING = 1.0  # error of predictions as a share of what changes: to predict that nothing changes errs by as much
PROBED = (0.95, 0.99)  # share of states with somebody inside the radius that are called unsafe
LITTLE = 0.9  # of what could be avoided: where the judged rows avoid less, V sees in time what they do not
HALF = 0.5  # likewise, of what the farthest look avoids that is usual
FOR_ONCE = 30  # rows of a look that is farther than that
BEARABLE = 0.3  # error of predictions as a share of what changes, or of what is read, up to which more rows count
# The same of what causes read, so many rows ahead: where it was 31 and 33 %, guards left at most 1 % of episodes; where
# it was 53 % and 87 %, of rays, 33 to 52 %.
DIMLY = 0.4
USUALLY = 10
AHEAD_KEPT = 0.9  # of the safe steps, by V: cars and discs are at 0.94 and more, robots, logged too fast, at 0 to 0.8
FORMULA = "give a formula of danger (hazard) if it is of distances or speeds"


def decided(card: Card) -> Card:
    """The card with its verdict, and with what guards are to look at."""
    return replace(card, verdict=judge(card), look=look_of(card))


# --- the verdict ---


def judge(card: Card) -> Verdict:
    """The verdict on the World of this card."""
    if card.barrier is None:
        reason = "it knows no danger: no step of its logs costs, or every step, or it was fitted without a barrier"
        return Verdict("unfit", (reason,), ("log steps of both kinds, or give a formula of danger",))
    untold = _remedy_of_untold(card)
    found = list(_barrier(card.barrier, "", untold))
    for name, scores in (card.constraints or {}).items():
        found += _barrier(scores, f" of '{name}'", untold)
    scores = card.constraints or {"": card.barrier}
    for name, causes in card.causes.items():
        found += _told(causes, scores.get(name, card.barrier).recall, f" of '{name}'" if name else "", untold)
    found += _prediction(card)
    found += _late(Lateness(card.data.late))
    worst: Word = "fit"
    for word in ("weak", "unfit"):
        if any(given == word for given, _, _ in found):
            worst = word
    if worst == "fit":
        return Verdict(worst, tuple(_carried(list(scores.values()))))
    shown = [(reason, remedy) for given, reason, remedy in found if given == worst]
    return Verdict(worst, tuple(r for r, _ in shown), _each_once([m for _, m in shown]))


def _each_once(remedies: Sequence[str]) -> tuple[str, ...]:
    """Without those that another says, too."""
    return tuple(one for one in dict.fromkeys(remedies) if not any(one != more and one in more for more in remedies))


def _carried(scores: Sequence[BarrierScores]) -> Iterator[str]:
    """The numbers that carried a World that is fit, the least of its constraints."""
    found = (
        ("{:.1%} of unsafe steps are found", [one.recall for one in scores]),
        ("{:.1%} of safe steps keep the margin", [one.margin_kept for one in scores]),
        ("{:.1%} of entries into danger are predicted", [1 - one.miscoverage for one in scores]),
    )
    for words, values in found:
        if known := [value for value in values if not math.isnan(value)]:
            yield words.format(min(known))


def _barrier(scores: BarrierScores, of: str, untold: str) -> Iterator[tuple[Word, str, str]]:
    """(word, reason, remedy) of what is amiss."""
    if scores.warning:
        yield "unfit", f"{scores.warning}{of}", "log more episodes with danger"
        return
    checks = (
        (scores.entries, ENTRIES, "{:.0f} held-out steps enter danger", "log more episodes with danger"),
        (scores.recall, RECALL, "{:.1%} of unsafe steps are found", untold),
        (scores.margin_kept, KEPT, "{:.1%} of safe steps keep the margin", "log more, and more careful, episodes"),
        (
            1 - scores.miscoverage,
            FORESEEN,
            "{:.1%} of entries into danger are predicted",
            "log what decides where danger begins, or more episodes",
        ),
        (_avoided(scores), AVOIDABLE, "{:.0%} of danger can be avoided", "log stronger braking and turning"),
        (
            scores.probed,
            PROBED,
            f"{{:.1%}} of states with something put nearer than {_radius(scores)} are called unsafe",
            "give a formula of danger",
        ),
    )
    for value, limits, words, remedy in checks:
        word = _word(value, limits)
        if word != "fit":
            yield word, f"only {words.format(value)}{of}", remedy


def _radius(scores: BarrierScores) -> str:
    """The distances inside of which things were put, as the logs tell where danger begins."""
    put = [f"{one.edge:.3g} ({one.name.removesuffix(PUT)})" for one in scores.probes if one.unsafe]
    return " and ".join(put) or "danger begins"


def _told(causes: Found, recall: float, of: str, untold: str) -> Iterator[tuple[Word, str, str]]:
    """What causes leave out, all where none is found: a score may find much of it, in the logs, and holds nobody off
    the rest."""
    if causes.searched and not causes.causes:
        reason = (
            f"no cause of its danger{of} is found: a network on all entries tells it, which knows no place but those"
        )
        yield "weak", f"{reason} that were logged", untold
    word = _word(causes.explained, TOLD)
    if causes.causes and word != "fit" and recall < NEARLY_ALL:
        yield word, f"its causes tell only {causes.explained:.1%} of the danger{of}", FORMULA


def _remedy_of_untold(card: Card) -> str:
    """What helps where danger is not found: what has no name may tell it; else few named entries cannot."""
    names = () if card.prediction_error is None else card.prediction_error.by_entry
    if not names or any(UNNAMED.match(name) for name in names):
        return "name the entries that tell danger, or log them"
    return f"log what tells danger, or {FORMULA}"


def _avoided(scores: BarrierScores) -> float:
    return max(scores.avoidable.avoided) if scores.avoidable else math.nan


def _word(value: float, limits: tuple[float, float]) -> Word:
    """What a number means; one that is not known means nothing."""
    unfit, weak = limits
    if math.isnan(value) or value >= weak:
        return "fit"
    return "unfit" if value < unfit else "weak"


def _prediction(card: Card) -> Iterator[tuple[Word, str, str]]:
    error = card.prediction_error
    if error is None:
        return
    remedy = "log more episodes, or more of what decides how agents move"
    told = any(causes.causes for causes in card.causes.values())
    for one in error.read:
        at = max((k for k, steps in enumerate(one.steps_ahead) if steps <= USUALLY), default=0)
        share = one.error[at] / max(one.deviation, 1e-9)
        if told and share > DIMLY:
            when = f"{one.seconds[at]:g} s" if one.seconds else f"{one.steps_ahead[at]} steps"
            found = f"{one.name} is predicted to {one.error[at]:.3g} at {when}, {share:.0%} of its deviation"
            yield "unfit" if share > NOTHING else "weak", found, remedy
        if not one.beats_coasting:
            when = f"{one.seconds[-1]:g} s" if one.seconds else f"{one.steps_ahead[-1]} steps"
            ours, theirs = f"{one.error[-1]:.3g}", f"{one.coasting[-1]:.3g}"
            yield "weak", f"it errs by {ours} in {one.name} at {when}, and constant velocity by {theirs}", remedy
    ours = max(error.error_of_change, default=0.0)
    if ours > NOTHING:
        yield "unfit", f"its predictions err by {_times(ours)} as much as what they predict changes at all", remedy
    if not error.coasting:
        return
    ours, theirs = error.error_of_change[-1], error.coasting[-1]
    if ours > theirs:
        yield (
            "weak",
            f"its predictions err by {ours:.0%} of what changes where constant velocity errs by {theirs:.0%}",
            remedy,
        )


def _late(late: Lateness) -> Iterator[tuple[Word, str, str]]:
    if late.any:
        yield "unfit", f"it takes commands to act at once, and these act {late}", late.remedy


def _times(ratio: float) -> str:
    return f"{ratio:.1f} times" if ratio < 100 else "hundreds of times"


def require(card: Card, anyway: bool = False) -> None:
    """Refuse to guard by a World that is unfit, unless it is insisted on."""
    verdict = card.verdict or judge(card)
    if verdict.word != "unfit" or anyway:
        return
    raise UserError(
        f"The World of '{card.data.task}' is unfit to guard by: {'; '.join(verdict.reasons)}; "
        f"{' or '.join(verdict.remedies)}, or insist with anyway=True (--anyway)."
    )


def require_values(card: Card, anyway: bool = False) -> None:
    """Refuse to climb values that are worse than none, unless it is insisted on."""
    if card.values is None or not card.values.misleads or anyway:
        return
    raise UserError(
        f"The World of '{card.data.task}' predicts returns-to-go worse than by their mean, and these options climb "
        "them; take guard='shield', leave value_guidance out, log more episodes, or insist with anyway=True (--anyway)."
    )


# --- how far guards look ---


def look_of(card: Card) -> Look:
    """What a guard is to look at, where a World is as its card says."""
    rows = _rows_foreseen_well(card)
    scores = card.barrier
    if rows == FARTHEST and scores is not None and scores.avoidable is not None:
        avoidable = scores.avoidable
        if _share_within(avoidable, FARTHEST) < HALF * max(avoidable.avoided):  # what adds up takes long to avoid
            rows = min(avoidable.rows, FOR_ONCE)
    if scores is None or scores.avoidable is None or not _too_late(scores.avoidable):
        return Look(rows)
    error = card.prediction_error
    if error is not None and error.error_of_change[-1] <= BEARABLE:
        return Look(rows, avoiding=min(scores.avoidable.rows, FARTHEST))
    return Look(rows, terminal_value=scores.ahead_kept >= AHEAD_KEPT)


def _rows_foreseen_well(card: Card) -> int:
    """Rows, FARTHEST at most, for which all that the barrier reads is predicted well; margins widen along them."""
    read = () if card.prediction_error is None else card.prediction_error.read
    scores = [] if card.barrier is None else (card.constraints or {"": card.barrier}).values()
    if not read or not scores or not all(one.widening for one in scores):  # those of before say nothing of rows ahead
        return 0
    well = [all(one.error[at] <= BEARABLE * one.deviation for one in read) for at in range(len(read[0].steps_ahead))]
    return min(max((k for k, told in zip(read[0].steps_ahead, well) if told), default=0), FARTHEST)


def _too_late(avoidable: Avoidable) -> bool:
    """Whether the rows that a guard judges avoid little of the danger that could have been avoided, e.g. where braking
    takes longer."""
    return _share_within(avoidable, JUDGED) < LITTLE * max(avoidable.avoided)


def _share_within(avoidable: Avoidable, rows: int) -> float:
    """Of danger that could still be avoided so many rows ahead."""
    return max((s for before, s in zip(avoidable.before, avoidable.avoided) if before <= rows), default=0.0)
