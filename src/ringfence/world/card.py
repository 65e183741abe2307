"""What is known of a World: typed numbers, as JSON in its file, and in words."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from typing import Any, Literal

import msgspec

from ringfence.errors import plain
from ringfence.problem.features import LESS
from ringfence.utils.config import build_config
from ringfence.utils.text import percent, significant
from ringfence.world.causes import Cause, Edge, Found
from ringfence.world.quantities import leaves
from ringfence.world.settings import Settings
from ringfence.world.stops import AHEAD, Stop

FARTHEST = 15  # rows that a guard looks ahead by itself (benchmarks/proving.py plays more of them)
JUDGED = 3  # steps ahead that the margin is calibrated for
NO_ERROR = 0.01  # of the deviation of what is predicted: less is exact enough
WIDENED = (5, 10, 15)  # rows ahead of which its words say what they ask for
LITTLE = 0.05  # margins, of which they say nothing
PUT = ", put into held-out states"  # what names of answers about somebody end with
UNNAMED = re.compile(r"(obs|state)\d+\b")  # entries that nobody named
LISTED = 6  # entries of a kind that its words list
SHOWN = 3  # things that a barrier reads, beside distances, whose prediction its words show
NO_CLIMB = ": guards that climb them (refine, full) are refused"
UNKNOWN = math.nan  # a number that held-out episodes say nothing of; files leave it out


class Part(msgspec.Struct, frozen=True, omit_defaults=True):
    """A part of the card."""


class Data(Part, frozen=True):
    """The data set that a World was fitted to."""

    task: str
    hazard: dict[str, Any]  # constraints.to_dict
    content: str = ""  # digest of its arrays
    episodes: int = 0
    constraints: dict[str, float] | None = None  # limit per episode of each one that the logs name
    observation_width: int | None = None  # entries of what an agent sees
    state_width: int | None = None  # of the global state
    dt: float | None = None  # seconds of a step, where the logs say
    unsafe_costs: dict[str, float] | None = None  # what a step that costs anything costs on average, of each; None: 1
    observation_origins: list[float] | None = None  # what was taken from each entry of the logs (problem/origins.py)
    state_origins: list[float] | None = None
    ranges: dict[str, tuple[float, float]] | None = None  # least and most of safe steps, of own entries and lengths
    # of entries that nobody named, or that are read by another name, by the one they have (problem/inferred_names.py)
    inferred_names: dict[str, str] | None = None
    impacts: int = 0  # unsafe steps that threw a body back (world/fit.py)
    action_delay: int = 0  # steps that commands took to take effect: a guard decides for so much later (logs/late.py)
    late: tuple[int | None, ...] = ()  # steps after which commands of each agent take effect, where not at once
    agents: list[str] | None = None  # their names, in order, where these say more than numbers do
    partners: bool = False  # predictions read what those do who are in lists of the nearest (problem/partners.py)
    stops: tuple[Stop, ...] = ()  # what nobody passes (world/stops.py)


class HeldOut(Part, frozen=True):
    """What nothing was fitted to."""

    episodes: int
    steps: int


class Foresight(Part, frozen=True):
    """How well one thing that a barrier reads is predicted, in its own unit."""

    name: str
    steps_ahead: tuple[int, ...]
    error: tuple[float, ...]  # root mean square, by steps ahead, along the logged actions
    coasting: tuple[float, ...]  # the same, where all goes on as it did in the last step
    deviation: float  # of what was logged
    seconds: tuple[float, ...] = ()  # that these steps take, where the logs say

    @property
    def beats_coasting(self) -> bool:
        """Whether anything is gained by its predictions; errors of a hundredth of what is logged are none."""
        return self.error[-1] <= max(self.coasting[-1], NO_ERROR * self.deviation)


class PredictionError(Part, frozen=True):
    """Errors of the forward models, rolled out along logged actions."""

    steps_ahead: tuple[int, ...]
    error_of_change: tuple[float, ...]  # root mean square error as a share of the change, by steps ahead
    by_entry: dict[str, tuple[float, ...]]  # root mean square error in the entry's unit: 1, 3 and all steps ahead
    coasting: tuple[float, ...] = ()  # the same share, where all goes on as it did in the last step
    read: tuple[Foresight, ...] = ()  # of everything that the barrier reads


class ValueScores(Part, frozen=True):
    """Shares of variance that the values explain."""

    reward_r2: float = UNKNOWN
    value_r2: float = UNKNOWN

    @property
    def misleads(self) -> bool:
        """Whether returns-to-go are predicted worse than by their mean, so that nothing is gained by climbing them."""
        return self.value_r2 < 0


class Threshold(Part, frozen=True):
    """Ensemble disagreement above which a state is out of distribution, in usual steps."""

    threshold: float
    level: float  # share of held-out episodes that stay below it throughout


class MarginScores(Part, frozen=True):
    """What a margin means on held-out steps."""

    margin: float
    unsafe_in_1000: float  # of the steps that have it, both classes as frequent as in the logs
    unsafe_predicted_above: float  # share of entries into danger that were predicted to have it
    safe_kept: float  # share of the safe steps that have it


class Avoidable(Part, frozen=True):
    """How much of the danger could still be avoided, as the World predicts it."""

    before: tuple[int, ...]  # steps before entering danger
    avoided: tuple[float, ...]  # share of the entries, likewise
    rows: int  # the horizon at which a guard avoids nearly all that can be avoided


class Probe(Part, frozen=True):
    """What a barrier answers when it is asked about one cause of danger."""

    name: str  # what is varied, e.g. "length of other.dx, other.dy"
    at: tuple[float, ...]  # values, from low to high; of a cause of several entries along the first
    scores: tuple[float, ...]  # median score there, in margins
    edge: float = UNKNOWN  # where danger begins, in the entry's unit
    unsafe: tuple[float, ...] = ()  # share of held-out states called unsafe with it put there, of a neighbour at rest
    unsafe_closing: tuple[float, ...] = ()  # the same of a neighbour that closes in, where names tell its velocity


class ProbeMap(Part, frozen=True):
    """What a barrier answers over a plane of two entries, such as one's own place."""

    name: str
    x: tuple[float, ...]  # values of the first entry, from low to high
    y: tuple[float, ...]  # of the second
    scores: tuple[tuple[float, ...], ...]  # in margins, a row for each y


class Verdict(Part, frozen=True):
    """Whether a World is fit to guard by."""

    word: Literal["fit", "weak", "unfit"]
    reasons: tuple[str, ...] = ()  # what is amiss, or the numbers that carried it
    remedies: tuple[str, ...] = ()

    def __str__(self) -> str:
        if not self.reasons:
            return self.word
        remedies = f"; {' or '.join(self.remedies)}" if self.remedies else ""
        return plain(f"{self.word}: {'; '.join(self.reasons)}{remedies}")


class BarrierScores(Part, frozen=True):
    """How well a barrier tells danger. With a `warning` the numbers are not known."""

    warning: str = ""
    unsafe_share: float = UNKNOWN
    auroc: float = UNKNOWN
    recall: float = UNKNOWN  # share of the unsafe steps that are found, at `false_alarms`
    false_alarms: float = UNKNOWN
    false_safe: float = UNKNOWN  # share of the unsafe steps with a score of 0 or more
    false_unsafe: float = UNKNOWN
    predicted_false_safe: float = UNKNOWN  # the same of entries into danger, by predicted scores
    margin: float = UNKNOWN  # the default one, calibrated
    miscoverage: float = UNKNOWN  # share of entries that are predicted to have it
    calibration: tuple[MarginScores, ...] = ()
    ahead_kept: float = UNKNOWN  # share of the safe steps that keep the margin by V
    avoidable: Avoidable | None = None
    # by cause, or one for all entries: what rows ahead ask for beyond the margin, in margins; the first row first
    widening: tuple[tuple[float, ...], ...] = ()
    entries: float = UNKNOWN  # held-out steps that entered danger
    margin_kept: float = UNKNOWN  # share of the safe steps that have the default margin
    probed: float = UNKNOWN  # share of held-out states that are called unsafe with somebody put inside the radius
    searched: float = UNKNOWN  # share of the steps that a guard's search calls safe, and the logs dangerous
    probes: tuple[Probe, ...] = ()
    maps: tuple[ProbeMap, ...] = ()


class Look(Part, frozen=True):
    """How guards look ahead by themselves, in rows."""

    rows: int = 0  # for which all that the barrier reads is predicted well
    avoiding: int = 0  # else: that avoiding danger takes, where the usual ones come too late; 0: the usual ones
    terminal_value: bool = False  # else: the value of danger is judged after the last row


class Card(msgspec.Struct, frozen=True, kw_only=True):
    """What is known of a World: its data, settings and seed, and how good it is on held-out episodes, e.g.
    `card.barrier.recall`. `print(card)` says it in words.

    It is a static field of the World. So it is hashed and compared by content: what was compiled for a World serves
    another one that is the same.
    """

    data: Data = Data(task="", hazard={})
    settings: Settings = Settings()
    seed: int = 0
    format: int = 0
    shape: str = ""  # of the barrier, in words
    causes: dict[str, Found] = {}  # of danger, by constraint ("" where the logs name none)
    seconds: dict[str, float] = {}  # that fitting each part took
    held_out: HeldOut | None = None
    prediction_error: PredictionError | None = None
    values: ValueScores | None = None
    ood: Threshold | None = None
    barrier: BarrierScores | None = None
    verdict: Verdict | None = None
    constraints: dict[str, BarrierScores] | None = None  # by name, where the logs name several
    look: Look | None = None  # None: of before; what reads a file decides it
    unread: dict[str, Any] = {}  # what else a file says of it

    def __hash__(self) -> int:
        return hash((self.data.task, self.data.content, self.seed, self.format))

    def __str__(self) -> str:
        return "\n".join(summary(self))

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Card:
        """The card of a file. What it does not name stays in `unread`; msgspec.ValidationError where a part is none."""
        settings = build_config(Settings, stored["settings"], "the World")
        parts = {name: value for name, value in stored.items() if name != "settings"}
        card = msgspec.structs.replace(msgspec.convert(parts, cls), settings=settings)
        return msgspec.structs.replace(card, unread=_beyond(stored, card.to_json()))

    def to_json(self) -> dict[str, Any]:
        """The card as files hold it."""
        parts = msgspec.to_builtins(self)
        more = parts.pop("unread")
        known = {name: value for name, value in parts.items() if value not in (None, {})}
        return _joined(known, more)


def _beyond(stored: Mapping[str, Any], known: Mapping[str, Any]) -> dict[str, Any]:
    """What a file holds beyond what is known of it, however deep it stands."""
    found: dict[str, Any] = {}
    for name, value in stored.items():
        if name not in known:
            found[name] = value
        elif isinstance(value, dict) and (more := _beyond(value, known[name])):
            found[name] = more
    return found


def _joined(known: dict[str, Any], more: Mapping[str, Any]) -> dict[str, Any]:
    """The same with what `_beyond` found."""
    found = dict(known)
    for name, value in more.items():
        found[name] = _joined(known[name], value) if name in known else value
    return found


# --- in words ---


def summary(card: Card) -> list[str]:
    """The card as a person reads it, line by line."""
    if not card.data.task:
        return ["an empty card"]
    lines = [*_of_data(card), *_of_prediction(card), *_of_barrier(card), *_of_verdict(card)]
    return [plain(line) for line in lines]  # which a file of anybody's may hold


def _of_data(card: Card) -> Iterator[str]:
    line = f"World of '{card.data.task}', seed {card.seed}, {card.settings.execution}: {card.data.episodes} episodes, "
    held_out = card.held_out
    if held_out is None:
        yield line + "judged on none."
        return
    yield f"{line}judged on {held_out.episodes} that nothing was fitted to ({held_out.steps} steps)."
    inferred = card.data.inferred_names or {}
    if named := [f"{name} ({entry})" for entry, name in inferred.items() if UNNAMED.match(entry)]:
        yield f"Logs tell what these entries are, which nobody named: {', '.join(named)}."
    given = {entry: name for entry, name in inferred.items() if not UNNAMED.match(entry)}
    if read := [f"{name} ({entry})" for entry, name in given.items() if LESS not in entry]:
        yield f"Logs tell what these entries are, which are read by other names than given: {', '.join(read)}."
    if apart := [f"{name} ({entry})" for entry, name in given.items() if LESS in entry]:
        more = f" and {len(apart) - LISTED} more" if len(apart) > LISTED else ""
        yield f"Entries are read less one's own, too: {', '.join(apart[:LISTED])}{more}."
    if card.data.partners:
        yield "Who is in lists of the nearest is found by what two see of each other; predictions read what these do."
    if stops := [stop.words for stop in card.data.stops if stop.name != AHEAD]:
        more = f" and {len(stops) - LISTED} more" if len(stops) > LISTED else ""
        yield f"What logs reach and never pass, nobody is predicted to pass: {', '.join(stops[:LISTED])}{more}."
    if card.data.impacts:
        yield (
            f"In {card.data.impacts} unsafe steps a body was thrown back by what it touched: danger is where it would "
            "have been."
        )


def _of_prediction(card: Card) -> Iterator[str]:
    if card.prediction_error is not None:
        errors = card.prediction_error.error_of_change
        shown = sorted({0, min(2, len(errors) - 1), len(errors) - 1})
        far = ", ".join(f"{percent(errors[k])} at {k + 1}" for k in shown)
        coasting = card.prediction_error.coasting
        beside = f" (constant velocity: {percent(coasting[-1])} at {len(coasting)})" if coasting else ""
        yield f"Prediction error as a share of what changes, steps ahead: {far}{beside}."
        yield from _of_foresight(card.prediction_error.read)
    if card.values is not None:
        yield (
            f"Rewards of steps {_explained(card.values.reward_r2)}, returns-to-go {_explained(card.values.value_r2)}"
            f"{NO_CLIMB if card.values.misleads else ''}."
        )
    if card.ood is not None:
        yield (
            f"Out of distribution is where its forward models are more than {card.ood.threshold:.2g} usual steps "
            f"apart: {100 * card.ood.level:g} % of held-out episodes never are."
        )


def _of_foresight(read: tuple[Foresight, ...]) -> Iterator[str]:
    """What a barrier reads, in its own unit: distances, and of the rest what constant velocity tells nearly as well."""
    changing = [one for one in read if one.error[-1] or one.coasting[-1]]
    order = sorted(changing, key=lambda one: one.coasting[-1] / max(one.error[-1], 1e-9))
    shown = [one for one in order if one.name.startswith("length of ")]
    shown += [one for one in order if one not in shown][:SHOWN]
    for one in shown:
        when = [f"{s:g} s" for s in one.seconds] or [f"{k} steps" for k in one.steps_ahead]
        far = ", ".join(f"{error:.3g} at {at}" for error, at in [*zip(one.error, when)][-2:])
        coasting = ", ".join(f"{error:.3g}" for error in one.coasting[-2:])
        beaten = "" if one.beats_coasting else ", which predicts it better"
        yield f"  {one.name}: predicted to {far} (constant velocity: {coasting}{beaten})"


def _explained(share: float) -> str:
    if math.isnan(share):
        return "do not vary"
    if share < 0:
        return "are predicted worse than by their mean"
    return f"are explained to {percent(share, 3)} of their variance"


def _of_barrier(card: Card) -> Iterator[str]:
    scores = card.barrier
    if scores is None:
        yield "No barrier: guards need a formula of danger."
        return
    if scores.warning:
        yield f"Barrier ({card.shape}): {scores.warning}."
        return
    yield f"Barrier: {card.shape}. {percent(scores.unsafe_share, 3)} of held-out steps are unsafe."
    yield (
        f"With 1 false alarm in 100 safe steps it finds {100 * scores.recall:.1f} % of the unsafe ones (AUROC "
        f"{scores.auroc:.4f}); at 0 it calls {percent(scores.false_safe)} of unsafe steps safe and "
        f"{percent(scores.false_unsafe)} of safe ones unsafe."
    )
    yield from _of_causes(card)
    for row in scores.calibration:
        yield (
            f"  of 1000 held-out steps with a margin of {row.margin:g} or more, {significant(row.unsafe_in_1000)} are "
            f"unsafe; {percent(row.safe_kept, 3)} of the safe steps have it"
        )
    if scores.avoidable is not None:
        yield _of_horizon(scores.avoidable, scores.ahead_kept, card.look or Look())
    if not math.isnan(scores.searched) and any(_is_of_places(found) for found in card.causes.values()):
        yield (
            "A guard that searches for actions, where drivers want anything, finds some that keep the margin; of the "
            f"steps where these lead, the logs call {percent(scores.searched)} dangerous, by own places and distances "
            "alone: other danger is not counted."
        )
    if card.constraints is None:
        yield (
            f"Default margin {scores.margin:.2g} (--margin 1 stands for it): of 1000 steps that entered danger, "
            f"predicted from up to {JUDGED} steps before, {significant(1000 * scores.miscoverage)} looked as safe."
        )
        yield from _of_widening(scores.widening, card.causes.get("", Found()))
        return
    for name, found in card.constraints.items():
        yield _of_constraint(name, (card.data.constraints or {}).get(name, UNKNOWN), found)


def _of_verdict(card: Card) -> Iterator[str]:
    if card.verdict is None:
        if card.barrier is not None and card.format:
            yield "VERDICT none: an earlier version fitted it; fit it again to have one."
        return
    yield f"VERDICT {card.verdict}."


def _of_causes(card: Card) -> Iterator[str]:
    for name, found in card.causes.items():
        of = f" of '{name}'" if name else ""
        parts = [
            f"{cause.name} ({percent(share, 3)}{_edge(cause, edge)})"
            for cause, share, edge in zip(found.causes, found.shares, found.edges)
        ]
        if parts:
            yield (
                f"Causes of danger{of}, with the share of unsafe steps that each tells: {'; '.join(parts)}; together "
                f"{percent(found.explained, 3)}, and {percent(found.false_alarms)} of the safe ones."
            )


def _is_of_places(found: Found) -> bool:
    """Whether some cause reads where somebody is."""
    each = (leaf.name for cause in found.causes for read in cause.reads for leaf in leaves(read))
    return any(re.fullmatch(r"own\.[xyz]|.*\.d[xyz]", name) for name in each)


def _edge(cause: Cause, edge: Edge) -> str:
    """Where it is dangerous; a rule's words say so themselves."""
    if cause.is_rule:
        return ""
    if edge.at is not None:
        return f", {_range(-math.inf, edge.at) if edge.below else _range(edge.at, math.inf)}"
    if not edge.bounds:
        return ""
    ends = [*([-math.inf] if edge.inside else []), *edge.bounds, math.inf]
    return f", {' or '.join(_range(low, high) for low, high in zip(ends[::2], ends[1::2]))}"


def _range(low: float, high: float) -> str:
    if math.isinf(low):
        return f"below {high:.3g}"
    return f"above {low:.3g}" if math.isinf(high) else f"{low:.3g} to {high:.3g}"


def _of_horizon(avoidable: Avoidable, kept: float, look: Look) -> str:
    shares = ", ".join(f"{percent(s, 3)} at {k}" for k, s in zip(avoidable.before, avoidable.avoided))
    far = f"; guards look up to {FARTHEST} ahead by themselves" if avoidable.rows > max(FARTHEST, look.rows) else ""
    line = (
        f"Could still be avoided, steps before entering danger: {shares}. Nearly all that can be takes a look "
        f"{avoidable.rows} ahead (horizon={avoidable.rows}{far}), where predictions reach that far"
    )
    if math.isnan(kept):
        return line + "."
    return f"{line}, or V, which leaves {percent(kept, 3)} of the safe steps their margin."


def _of_widening(widening: tuple[tuple[float, ...], ...], found: Found) -> Iterator[str]:
    """What rows ahead ask for beyond the margin, where that is anything."""
    names = [cause.name for cause in found.causes] or ["all entries"]
    asked = []
    for name, one in zip(names, widening):
        rows = [k for k in WIDENED if k <= len(one)]
        if any(one[k - 1] >= LITTLE for k in rows):
            asked.append(f"{name} {', '.join(f'{one[k - 1]:.2g} at {k}' for k in rows)}")
    if asked:
        yield f"Margins that are added for rows ahead, which are predicted worse: {'; '.join(asked)}."


def _of_constraint(name: str, limit: float, scores: BarrierScores) -> str:
    line = f"Constraint '{name}', at most {limit:g} per episode"
    if scores.warning:
        return f"{line}: {scores.warning}."
    return (
        f"{line}: {percent(scores.unsafe_share, 3)} of held-out steps are unsafe, of which it finds "
        f"{100 * scores.recall:.1f} % with 1 false alarm in 100 (AUROC {scores.auroc:.4f}); its margin is "
        f"{scores.margin:.2g}, the unit of the lines above."
    )
