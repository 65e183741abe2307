"""Whether a World is fit to guard by, with its reasons and what helps."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import Literal

from ringfence.errors import UserError
from ringfence.logs.late import Lateness
from ringfence.world.card import BarrierScores, Card, Verdict
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
UNNAMED = re.compile(r"(obs|state)\d+\b")  # entries that nobody named
FORMULA = "give a formula of danger (hazard), e.g. where it is a sum or an area over the team"


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
        found += _told(causes, scores.get(name, card.barrier).recall, f" of '{name}'" if name else "")
    found += _prediction(card)
    found += _late(Lateness(card.data.late))
    worst: Word = "fit"
    for word in ("weak", "unfit"):
        if any(given == word for given, _, _ in found):
            worst = word
    shown = [(reason, remedy) for given, reason, remedy in found if given == worst] if worst != "fit" else []
    return Verdict(worst, tuple(r for r, _ in shown), tuple(dict.fromkeys(m for _, m in shown)))


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
        (scores.probed, PROBED, "{:.1%} of states inside the radius are called unsafe", "give a formula of danger"),
    )
    for value, limits, words, remedy in checks:
        word = _word(value, limits)
        if word != "fit":
            yield word, f"only {words.format(value)}{of}", remedy


def _told(causes: Found, recall: float, of: str) -> Iterator[tuple[Word, str, str]]:
    """What causes leave out: a score of theirs may find much of it, in the logs, and holds nobody off the rest."""
    word = _word(causes.explained, TOLD)
    if causes.causes and word != "fit" and recall < NEARLY_ALL:
        yield word, f"its causes tell only {causes.explained:.1%} of the danger{of}", FORMULA


def _remedy_of_untold(card: Card) -> str:
    """What helps where danger is not found: what has no name may tell it; else few named entries cannot."""
    names = () if card.prediction_error is None else card.prediction_error.by_entry
    if not names or any(UNNAMED.match(name) for name in names):
        return "name the entries that tell danger, or log them"
    return f"log what tells danger, if it is not among the entries, or {FORMULA}"


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
    for one in error.read:
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
        f"The World of '{card.data.task}' predicts returns-to-go worse than by their mean, and this guard climbs them; "
        "take guard='shield', log more episodes, or insist with anyway=True (--anyway)."
    )
