"""Causes of a cost column, found by what is never safe.

A cost says that a step was unsafe, and neither who was in danger nor why. But a step without cost says much: wherever
any agent was in it, and however near any two were, was safe. So of every small set of entries (a place, a speed, the
distance to another) it is counted how often a step is unsafe when somebody is in a cell of it. A cause is a set with
cells where steps are nearly always unsafe, and it is the simplest that tells held-out steps best. What it tells is
then explained, and the next cause is looked for in what is left, so that a rare one is found, too; last those that
hold for some agents alone, such as how far one may fall behind the one before it.

This is a noisy-or over causes and agents (Pearl 1988), grown greedily: P(safe) = Π over causes, agents and things of
(1 − p(cell)). Entries that come along with danger (goals, velocities, others' places) tell nothing that is left.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from msgspec.structs import replace

from ringfence.problem.entries import Entries
from ringfence.world.cause_candidates import beside, candidates, of_several, of_team, offsets, pairs, products, wider
from ringfence.world.cause_counts import (
    Counted,
    Explained,
    Steps,
    counted,
    gain,
    likelihood,
    refined,
    some_steps,
    within,
)
from ringfence.world.causes import CELLS, Cause, Cells, Edge, Found, narrowed, only_of, only_where
from ringfence.world.quantities import All, Entry, Length, Over, Quantity, Sum, leaves
from ringfence.world.rules import rules_of, tilted_of, weighted_of

MOST = 8  # causes
SIMPLER = 0.02  # share of a gain that a simpler cause may lack
LEAST_GAIN = 0.002  # of the likelihood that there is to win
SURE = 3.0  # standard errors, over episodes, by which a gain has to exceed nothing
NEEDED = 2.0  # standard errors, by which one that is kept beside all others has to
PURE = 0.8  # share of the steps that a cause calls unsafe, and that are, of one that is no mixture of others
ENOUGH = 0.98  # share of unsafe steps, and of safe ones, that causes tell, from which on nothing else is tried
NEARLY_ALL = 0.9  # of the likelihood that is left to win: what tells so much of unseen episodes is no accident
LIKELY = 12  # causes, those that tell most of all agents, that may hold for some alone
FEW = 6  # episodes with danger, below which anything is
ALIKE = 0.95  # share of the steps within another entry's edges that are unsafe, where they are this one's, too
SLANTED = 0.2  # share of the steps told wrongly that a threshold which depends on others has to tell rightly
NEEDLESS = 0.002  # share of the unsafe steps that a cause has to tell alone
EPISODES = 2  # in which they have to be: one alone may be an accident


def find(
    x: np.ndarray, unsafe: np.ndarray, episode: np.ndarray, names: Sequence[str], seed: int = 0, team: bool = True
) -> tuple[Found, list[Cells]]:
    """The causes of danger in steps that led to features x (T, N, D), `unsafe` (T,) of the team or (T, N) bool of each
    agent, of these episodes (T,); with the cells of each cause."""
    steps = some_steps(x, unsafe, episode, np.random.default_rng([seed, 5]))
    chosen = _with_more_shapes(steps, _split(steps, _best_grown(steps, names), names), names, team)
    if not chosen:
        return Found(searched=True), []
    chosen = _foreseen(steps, [counted(steps, one.cause, _without(steps, chosen, one)) for one in chosen], names)
    edges = [refined(steps, one.cells.edge, one.cause, _without(steps, chosen, one)) for one in chosen]
    alike = _siblings(steps, chosen, edges, names)[: MOST - len(chosen)]
    chosen += [one for one, _ in alike]
    edges += [edge for _, edge in alike]
    called = [_by_other_parts(steps, one, _without(steps, chosen, one)) for one in chosen]
    kept = _needed(steps, called)
    chosen, called = [chosen[k] for k in kept], [called[k] for k in kept]
    edges = [edges[k] for k in kept]
    return replace(_summary(steps, chosen, called), edges=tuple(edges), searched=True), [one.cells for one in chosen]


def _foreseen(steps: Steps, chosen: list[Counted], names: Sequence[str]) -> list[Counted]:
    """The causes, how far others are in the place of what sensors see of them, where it tells as much: how bodies move
    is foreseen better than ranges are."""
    for k, one in enumerate(chosen):
        if one.cause.width > 1 or Entries.of([leaf.name for leaf in leaves(one.cause.reads[0])]).each:
            continue
        explained = _without(steps, chosen, one)
        far = [counted(steps, cause, explained) for cause in _about_whom(steps, offsets(names))]
        wrong = [_told_wrong(steps, other, explained) for other in far]
        most = _told_wrong(steps, one, explained) + NEEDLESS * steps.unsafe.sum()
        if far and min(wrong) <= most:
            chosen = [*chosen[:k], far[int(np.argmin(wrong))], *chosen[k + 1 :]]
    return chosen


def _needed(steps: Steps, called: list[np.ndarray]) -> list[int]:
    """Which causes tell something that no other does, by the steps that each calls unsafe; those that tell least are
    left out first. What was found by cells may be needless once edges are known."""
    kept = list(range(len(called)))
    for k in sorted(kept, key=lambda k: int((called[k] & steps.unsafe).sum())):
        rest = [called[other] for other in kept if other != k]
        if rest and (called[k] & steps.unsafe & ~np.logical_or.reduce(rest)).sum() <= NEEDLESS * steps.unsafe.sum():
            kept.remove(k)
    return kept


def _best_grown(steps: Steps, names: Sequence[str]) -> list[Counted]:
    """The causes that tell most, of those of all agents first, and of pure ones of anybody.

    What is true of some agents alone looks like a blurred cause of all: far from the next one in a row of agents, whom
    each has among other entries. A blurred cause is taken first since it tells most, and hides the true ones.
    """
    chosen = _pruned(steps, _grown(steps, names))
    if steps.x.shape[1] == 1 or (chosen and _summary(steps, chosen).explained > ENOUGH):
        return chosen
    pure = _pruned(steps, _grown_of_pure(steps, names))
    more, error = gain(steps, Explained.by(steps, chosen), Explained.by(steps, pure).safe)
    less = gain(steps, Explained.by(steps, pure), Explained.by(steps, chosen).safe)[0]
    return pure if more - less > SURE * error else chosen


def _with_more_shapes(steps: Steps, chosen: list[Counted], names: Sequence[str], team: bool) -> list[Counted]:
    """The causes, or those that are found with more that may be read, where these tell more. Aircraft are too near
    where they are near across and in height, vehicles where they are along and aside, or near and fast; what is ahead
    is in danger, or what would meet soon; or who is fast in some place; and loads are the team's. What is multiplied
    is read where all of these tell too little."""
    if _tell_enough(steps, chosen):
        return chosen
    several = [one for one in _about_whom(steps, of_several(names)) if _is_of_several(steps, one)]
    shapes = [*_about_whom(steps, pairs(names)), *several, *(_about_whom(steps, of_team(names)) if team else ())]
    chosen = _told_by(steps, chosen, shapes, names, multiplied=False)
    if _tell_enough(steps, chosen):
        return chosen
    return _told_by(steps, chosen, [*shapes, *_about_whom(steps, products(names))], names, multiplied=True)


def _told_by(
    steps: Steps, chosen: list[Counted], shapes: list[Cause], names: Sequence[str], multiplied: bool
) -> list[Counted]:
    """The causes, or those that are found with these shapes, where they tell more."""
    pool = [*_about_whom(steps, candidates(names)), *shapes]
    found = _added(steps, [], pool)
    if not _tell_enough(steps, found):  # some may hold for some agents alone
        nothing = Explained.by(steps, [])
        likely = sorted(shapes, key=lambda cause: -counted(steps, cause, nothing).gain)[:LIKELY]
        found = _added(steps, found, [one for cause in likely for one in only_of(cause, steps.x.shape[1])], PURE)
    found = _pruned(steps, list({one.cause: one for one in reversed(found)}.values())[::-1])
    chosen = _as_rules(steps, chosen, shapes, names, multiplied)
    found = _as_rules(steps, found, shapes, names, multiplied)
    if not _tell_enough(steps, found):  # exact ones leave more to tell than those that they were made of
        found = _pruned(steps, _added(steps, found, [one.cause for one in chosen]))
    more, error = gain(steps, Explained.by(steps, chosen), Explained.by(steps, found).safe)
    less = gain(steps, Explained.by(steps, found), Explained.by(steps, chosen).safe)[0]
    worse = _wrong_together(steps, found) - _wrong_together(steps, chosen) > NEEDLESS * steps.unsafe.sum()
    return found if not worse and more - less > SURE * error else chosen


def _wrong_together(steps: Steps, chosen: list[Counted]) -> int:
    """Steps that they tell wrongly."""
    called = [_by_other_parts(steps, one, _without(steps, chosen, one)) for one in chosen]
    return int((np.logical_or.reduce([np.zeros(steps.unsafe.shape, bool), *called]) != steps.unsafe).sum())


def _as_rules(
    steps: Steps, chosen: list[Counted], pool: Sequence[Cause], names: Sequence[str], multiplied: bool
) -> list[Counted]:
    """The causes, those of several numbers as rules where these tell as much."""
    for k, one in enumerate(chosen):
        explained = _without(steps, chosen, one)
        best = _as_rule(steps, one, pool, explained) if one.cause.width > 1 else _among(steps, one, explained)
        chosen = [*chosen[:k], _tilted(steps, best, names, explained, multiplied), *chosen[k + 1 :]]
    return _pruned(steps, chosen)


def _among(steps: Steps, one: Counted, explained: Explained) -> Counted:
    """The cause of the nearest of several things without those that tell nothing: who must be near some is lost when
    near others, too."""
    best = counted(steps, one.cause, explained)
    while isinstance(read := best.cause.reads[0], Over) and read.rank and read.count > 1:
        among = read.among or tuple(range(read.count))
        rest = [tuple(j for j in among if j != left) for left in among]
        fewer = [replace(read, rank=min(read.rank, len(some)), count=len(some), among=some) for some in rest]
        tried = [counted(steps, replace(best.cause, reads=(each,)), explained) for each in fewer]
        more = max(tried, key=lambda each: each.gain)
        if more.gain <= (1 + SIMPLER) * best.gain:
            break
        best = more
    return best


def _tilted(steps: Steps, best: Counted, names: Sequence[str], explained: Explained, multiplied: bool) -> Counted:
    """The cause with thresholds that depend on other numbers, or a sum over the team with weights, while these tell
    clearly more: boxes as long as both are, limits that fall along a way. Plain numbers do before what is
    multiplied."""
    for also in (False, True)[: 1 + multiplied]:
        more = [one for one in beside(best.cause, names, also) if _varies(steps, one) and _is_another(steps, one)]
        best = _shifted(steps, best, more, explained)
    return best


def _shifted(steps: Steps, best: Counted, more: Sequence[Quantity], explained: Explained) -> Counted:
    """The cause with thresholds that depend on some of these numbers, while it tells clearly more so."""
    least = NEEDLESS * steps.unsafe.sum()
    before = _told_wrong(steps, best, explained)
    while before > least:
        tried = [*weighted_of(steps, best, explained), *tilted_of(steps, best, explained, more)]
        found = [counted(steps, cause, explained) for cause in tried if cause != best.cause]
        enough = (1 - SIMPLER) * max((one.gain for one in found), default=0.0)
        better = next((one for one in found if one.gain >= enough), None)
        if better is None:
            break
        gained, error = gain(steps, explained.beside(best), better.safe)
        lost = gain(steps, explained.beside(better), best.safe)[0]
        after = _told_wrong(steps, better, explained)
        if before - after <= max(SLANTED * before, least) or gained - lost <= SURE * error:
            break
        best, before = better, after
    return best


def _told_wrong(steps: Steps, one: Counted, explained: Explained) -> int:
    called = _by_other_parts(steps, one, explained)
    return int(((explained.left > 0.5) & ~called).sum() + (~steps.unsafe & called).sum())


def _varies(steps: Steps, quantity: Quantity) -> bool:
    return bool(Cause((quantity,)).varies(steps.varies).any())


def _numbers_of(cause: Cause) -> list[Quantity]:
    """What the conditions of a rule of several read."""
    read = cause.reads[0]
    each = read.parts if isinstance(read, All) else ()
    return [part for one in each if isinstance(one, Sum) for part in one.parts]


def _folded(steps: Steps, cause: Cause) -> Iterator[Cause]:
    """A cause of two entries by how far some are from 0, of those that lie on both sides."""
    if cause.width != 2 or not all(isinstance(read, Entry) for read in cause.reads):
        return
    far = [Length((read,)) if _is_another(steps, Length((read,))) else read for read in cause.reads]
    for reads in itertools.product(*[(a, b) for a, b in zip(cause.reads, far)]):
        if reads != cause.reads:
            yield Cause(reads, cause.who)


def _is_another(steps: Steps, quantity: Quantity) -> bool:
    """Whether it tells what a number does not that it is made of: how far that is from 0, on both sides."""
    if not isinstance(quantity, Length) or len(quantity.parts) != 1:
        return True
    x = quantity.parts[0].of(steps.x)
    return bool((x < 0).any() and (x > 0).any())


def _is_of_several(steps: Steps, cause: Cause) -> bool:
    """Whether the distance of the k-th nearest tells what that of each does not: that of the nearest does so where it
    is dangerous to be far from all, and that of the farthest where it is to be near all."""
    (read,) = cause.reads
    if not isinstance(read, Over):
        return True
    below = counted(steps, cause, Explained.by(steps, [])).cells.edge.below
    return read.rank > 1 if below else read.rank < read.count


def _tell_enough(steps: Steps, chosen: list[Counted]) -> bool:
    """Whether causes tell nearly all unsafe steps, and call hardly any others unsafe, as few as they may miss."""
    return _wrong_together(steps, chosen) < (1 - ENOUGH) * steps.unsafe.sum()


def _as_rule(steps: Steps, one: Counted, pool: Sequence[Cause], explained: Explained) -> Counted:
    """A cause of several numbers as a rule, near *and* fast or in sight, or near soon, where this tells as much: then
    its edges are known as well as those of a distance are. So are others that read the same entries."""
    about = one.cause.entries()
    alike = [cause for cause in pool if cause.width > 1 and cause.entries() == about]
    alike = [counted(steps, cause, explained) for cause in (*alike, *_folded(steps, one.cause))]
    own = counted(steps, one.cause, explained)
    likely = [other for other in (own, *alike) if other.gain >= (1 - SIMPLER) * own.gain]
    rules = [counted(steps, rule, explained) for other in likely for rule in rules_of(steps, other, explained)]
    found = _simplest_rule([own, *rules])
    if found is not own:
        return found
    tilted = (new for box in rules for new in tilted_of(steps, box, explained, _numbers_of(box.cause)))
    return _simplest_rule([own, *(counted(steps, rule, explained) for rule in tilted)])


def _simplest_rule(found: Sequence[Counted]) -> Counted:
    """The simplest rule of those that tell about as much as any; the first, which is none, where all tell less."""
    own, *rules = found
    least = (1 - SIMPLER) * max(one.gain for one in found)
    enough = [rule for rule in rules if rule.gain >= least]
    return min(enough, key=lambda rule: (len(rule.cause.reads[0].parts), -rule.gain), default=own)


def _split(steps: Steps, chosen: list[Counted], names: Sequence[str]) -> list[Counted]:
    """The causes with some of fewer entries in the place of one of more, where these tell as much: two walls for a
    room, those before and behind oneself for a row. A place that nobody visited is then no danger of its own."""
    for one in [one for one in chosen if one.cause.width > 1]:
        if one not in chosen:  # another's parts tell it, too
            continue
        rest = [t for t in chosen if t is not one]
        parts = _added(steps, rest, list(_of_fewer_entries(steps, one.cause, names)), PURE)[len(rest) :]
        explained = Explained.by(steps, rest)
        told = gain(steps, explained, Explained.by(steps, parts).safe)[0]
        less = told < (1 - SIMPLER) * gain(steps, explained, one.safe)[0]
        both = [*rest, *parts]
        beside = (counted(steps, part.cause, _without(steps, both, part)) for part in both)
        if parts and not less and all((part.cells.danger > 0.5).any() for part in beside):  # each has some of its own
            chosen = _pruned(steps, both)
    return chosen


def _of_fewer_entries(steps: Steps, cause: Cause, names: Sequence[str]) -> Iterator[Cause]:
    """Causes of some of the entries of one, of all agents for whom these vary, and of each."""
    whole = set(cause.entries())
    for fewer in candidates(names):
        if fewer.goes_on or not all(any(thing < every for every in whole) for thing in fewer.entries()):
            continue
        vary = steps.vary(fewer)
        if vary.all():
            yield fewer
        elif vary.any():
            yield only_where(fewer, vary)
        yield from (one for one in only_of(fewer, len(vary)) if vary[one.who[0]])


def _about_whom(steps: Steps, causes: Iterable[Cause]) -> Iterator[Cause]:
    """The causes, each of the agents who have what it reads: without those for whom none of its things varies.
    A place of a list that nobody ever takes is not missing, where another is taken."""
    for cause in causes:
        have = np.asarray(steps.vary(cause).any(1))  # (N,)
        held = cause.holds(len(have)) & have[:, None]
        if have.all():
            yield cause
        elif held.any():
            yield only_where(cause, held)


def _grown_of_pure(steps: Steps, names: Sequence[str]) -> list[Counted]:
    """Causes of all agents and of some alone, of which nearly all steps that they call unsafe are: those of one entry
    first, then lengths, then all others."""
    pool = list(_about_whom(steps, candidates(names)))
    alone = [one for cause in pool for one in only_of(cause, steps.x.shape[1])]
    chosen: list[Counted] = []
    for fits in (lambda cause: cause.width == 1 and not cause.goes_on, lambda cause: cause.width == 1, lambda _: True):
        chosen = _added(steps, chosen, [cause for cause in (*pool, *alone) if fits(cause)], PURE)
    chosen = _pruned(steps, chosen)
    for k, one in enumerate(chosen):
        chosen[k] = _of_fewer(steps, one, _without(steps, chosen, one))
    return [_widened(steps, one, _without(steps, chosen, one), names) for one in chosen]


def _of_fewer(steps: Steps, one: Counted, explained: Explained) -> Counted:
    """The cause without agents who tell nothing beside the others: they were taken for what was found later."""
    best = counted(steps, one.cause, explained)
    for who in one.cause.who:
        rest = tuple(other for other in best.cause.who if other != who)
        if rest and (fewer := counted(steps, narrowed(best.cause, rest), explained)).gain >= best.gain:
            best = fewer
    return best


def _grown(steps: Steps, names: Sequence[str]) -> list[Counted]:
    """Causes, one after the other, each the simplest of those that tell most of what is left: first those that hold for
    all agents, then those that hold for some alone."""
    pool = list(_about_whom(steps, candidates(names)))
    chosen = _added(steps, [], pool)
    n_agents = steps.x.shape[1]
    if n_agents > 1 and len(chosen) < MOST:
        alone = [one for cause in pool for one in only_of(cause, n_agents)]
        chosen = _added(steps, chosen, alone)
        chosen = _simplified(steps, _pruned(steps, chosen), pool)
    return [_widened(steps, one, _without(steps, chosen, one), names) for one in chosen]


def _simplified(steps: Steps, chosen: list[Counted], pool: Sequence[Cause]) -> list[Counted]:
    """The causes of all agents as simple as they can be beside the others: what was found first may have stood for what
    was found later, too."""
    for k, one in enumerate(chosen):
        if not one.cause.who:
            about = one.cause.entries()[0]
            related = [cause for cause in pool if cause.entries()[0] <= about]
            chosen[k] = _simplest(steps, related, _without(steps, chosen, one)) or one
    return chosen


def _added(steps: Steps, chosen: list[Counted], pool: Sequence[Cause], pure: float = 0.0) -> list[Counted]:
    """These causes and more of the pool, while they tell something; at least as pure as that."""
    chosen = list(chosen)
    least = LEAST_GAIN * -likelihood(steps, np.zeros(steps.unsafe.shape)).sum() / len(steps.x)
    while len(chosen) < MOST:
        explained = Explained.by(steps, chosen)
        best = _simplest(steps, pool, explained, pure)
        if best is None or best.gain < least:
            break
        if best.gain < SURE * best.error and not _tells_nearly_all(steps, best, explained):
            break
        if best.cause.who:
            best = _gathered(steps, best, pool, explained)
        chosen.append(best)
    return chosen


def _tells_nearly_all(steps: Steps, one: Counted, explained: Explained) -> bool:
    """Whether a cause of one number tells nearly all that is left, of episodes that its edges were not read off. Danger
    that is scarce lies in a few episodes, of which some hold most of it; no gain is many standard errors there."""
    left = explained.left > 0.5
    if not one.cells.edge.bounds or len(np.unique(steps.episode[left if left.ndim == 1 else left.any(1)])) < FEW:
        return False
    called = _by_other_parts(steps, one, explained)
    share = min(steps.unsafe[called].mean(), 0.999) if called.any() else 0.0
    safe = np.where(called, np.log1p(-share), 0.0)
    to_win = -explained.likelihood.mean() * (1 if steps.unsafe.ndim == 1 else steps.unsafe.shape[1])
    return gain(steps, explained, safe)[0] > NEARLY_ALL * to_win


def _by_other_parts(steps: Steps, one: Counted, explained: Explained) -> np.ndarray:
    """(T,) or (T, N) bool: in danger by a cause; of one number its edges are read off the other episodes."""
    if not one.cells.edge.bounds:
        return one.called
    found = np.zeros(steps.unsafe.shape, bool)
    for fold in np.unique(steps.fold):
        own = steps.fold == fold
        rest = steps.part(~own)
        edge = refined(rest, one.cells.edge, one.cause, explained.of(rest, ~own))
        found[own] = within(steps.part(own), one.cause, edge)
    return found


def _gathered(steps: Steps, best: Counted, pool: Sequence[Cause], explained: Explained) -> Counted:
    """The cause of a single agent as one of all for whom it holds likewise, one after the other."""
    others = [cause for cause in pool if cause.who and cause.reads == best.cause.reads]
    for other in sorted(others, key=lambda cause: -counted(steps, cause, explained).gain):
        who = best.cause.who
        if other.who[0] in who:
            continue
        more = counted(steps, narrowed(best.cause, (*who, *other.who)), explained)
        if more.gain > (1 + SIMPLER) * best.gain:
            best = more
    return best


def _widened(steps: Steps, one: Counted, explained: Explained, names: Sequence[str]) -> Counted:
    """The cause with more entries, where these tell clearly more; once simple ones tell what they can, so that a second
    cause is not taken for a part of the first."""
    best = counted(steps, one.cause, explained)
    while (more := _best_wider(steps, best, explained, names)) is not None:
        best = more
    return best


def _simplest(steps: Steps, pool: Sequence[Cause], explained: Explained, pure: float = 0.0) -> Counted | None:
    """The simplest cause of those that tell about as much as any; at least as pure as that."""
    gains = [_gain_if(steps, counted(steps, cause, explained), pure) for cause in pool]
    least = (1 - SIMPLER) * max(gains, default=0.0)
    enough = [(cause, gain) for cause, gain in zip(pool, gains) if gain > 0 and gain >= least]
    if not enough:
        return None
    best, _ = min(enough, key=lambda one: (*_complexity(one[0]), -one[1]))
    return counted(steps, best, explained)


def _complexity(cause: Cause) -> tuple[int, bool, bool, bool]:
    """Of causes that tell as much, the one of which this is least is taken."""
    simple = all(isinstance(read, (Entry, Length)) for read in cause.reads)
    return cause.width, not cause.goes_on, not simple, bool(cause.who)


def _gain_if(steps: Steps, one: Counted, pure: float) -> float:
    """What a cause gains; nothing where it is less pure than that: fewer of the steps that it calls unsafe are."""
    if not pure:
        return one.gain
    called = one.called.sum()
    return one.gain if called and (one.called & steps.unsafe).sum() / called >= pure else 0.0


def _best_wider(steps: Steps, best: Counted, explained: Explained, names: Sequence[str]) -> Counted | None:
    """The cause with one more entry, where that tells clearly more."""
    tried = [counted(steps, cause, explained) for cause in _about_whom(steps, wider(best.cause, names))]
    found = max(tried, key=lambda t: t.gain, default=None)
    if found is None or found.gain < (1 + 2 * SIMPLER) * best.gain:
        return None
    return found if found.gain - best.gain > SURE * max(found.error, best.error) else None


def _pruned(steps: Steps, chosen: list[Counted]) -> list[Counted]:
    """Without those that the rest make needless."""
    for one in sorted(chosen, key=lambda t: t.gain):
        rest = [t for t in chosen if t is not one]
        more, error = gain(steps, Explained.by(steps, rest), one.safe)
        if rest and more < max(LEAST_GAIN * 0.5, NEEDED * error):
            chosen = rest
    return chosen


def _without(steps: Steps, chosen: list[Counted], one: Counted) -> Explained:
    return Explained.by(steps, [t for t in chosen if t is not one])


def _summary(steps: Steps, chosen: list[Counted], called: Sequence[np.ndarray] = ()) -> Found:
    """What causes tell, by the steps that each calls unsafe; by their cells where nothing else is said."""
    called = called or [one.called for one in chosen]

    def explained(called: np.ndarray) -> tuple[float, float]:
        return float(called[steps.unsafe].mean()), float(called[~steps.unsafe].mean())

    share, false_alarms = explained(np.logical_or.reduce(called))
    shares = tuple(round(explained(each)[0], 4) for each in called)
    return Found(tuple(one.cause for one in chosen), round(share, 4), round(false_alarms, 4), shares)


# --- entries that are dangerous where another one is ---


def _siblings(
    steps: Steps, chosen: Sequence[Counted], edges: Sequence[Edge], names: Sequence[str]
) -> list[tuple[Counted, Edge]]:
    """Entries, with where they are dangerous, that are no cause yet, and that tell unsafe steps which no cause tells by
    the edges of one. Too few steps show them to be found by themselves: of vehicles in a row the second and the third
    touched a hundred times, the first and the second twice. Twice is enough where another entry has told where danger
    begins, and nothing contradicts. Only edges at which danger was seen to begin and to end are tried: they fit hardly
    anything by chance."""
    known = {one.cause for one in chosen}
    alike = [edge for one, edge in zip(chosen, edges) if _is_plain(one.cause) and _between(edge)]
    if not alike:
        return []
    explained = Explained.by(steps, chosen)
    called = [within(steps, one.cause, edge) for one, edge in zip(chosen, edges) if edge.bounds]
    left = steps.unsafe & ~np.logical_or.reduce(called)
    found = []
    for cause in candidates(names):
        if not _is_plain(cause) or cause in known:
            continue
        for edge in (_moved(edge, cause.of(steps.x)) for edge in alike):
            inside = within(steps, cause, edge)
            if _is_told(steps, inside & left, inside & ~steps.unsafe):
                found.append((counted(steps, cause, explained), edge))
                left &= ~inside
                break
    return found


def _is_plain(cause: Cause) -> bool:
    """Whether it is one entry, of all agents."""
    return isinstance(cause.reads[0], Entry) and cause.width == 1 and not cause.who


def _between(edge: Edge) -> bool:
    """Whether danger was seen to begin and to end."""
    return len(edge.bounds) - sum(edge.unseen) >= 2


def _is_told(steps: Steps, unsafe: np.ndarray, safe: np.ndarray) -> bool:
    """Whether steps, each (T,) or (T, N) bool, are unsafe nearly always, and in more than one episode."""
    in_danger = unsafe if unsafe.ndim == 1 else unsafe.any(1)
    episodes = np.unique(steps.episode[in_danger])
    return len(episodes) >= EPISODES and bool(unsafe.sum() >= ALIKE * (unsafe.sum() + safe.sum()))


def _moved(edge: Edge, values: np.ndarray) -> Edge:
    """The edge for another entry: where the logs end is that one's own affair."""
    low, high = float(values.min()), float(values.max())
    beyond = (high - low) / CELLS[1]
    bounds = list(edge.bounds)
    if edge.unseen[0]:
        bounds[0] = min(low - beyond, bounds[1])
    if edge.unseen[-1]:
        bounds[-1] = max(high + beyond, bounds[-2])
    return replace(edge, low=(round(low, 4),), high=(round(high, 4),), bounds=tuple(bounds))
