"""What a guard makes of drivers inside its World, and what the verdict makes of that."""

import numpy as np
import pytest
from msgspec.structs import replace

from ringfence.guards import played
from ringfence.world.card import BarrierScores, Card, Played, PredictionError, summary
from ringfence.world.judging import Judging
from ringfence.world.logged import Logged
from ringfence.world.verdict import judge


def row(driver, alone, guarded, error=0.05, unknown=(0.0, 0.0), auroc=0.97, which=0):
    return Played(driver, which, alone, guarded, error, unknown, auroc)


def card(*rows, changed=(0.1, 0.2)):
    """Of a World that is fit, but for what was played, and for how much of what changes its predictions err by."""
    return Card(
        barrier=BarrierScores(entries=100.0, recall=0.99, margin_kept=0.9, miscoverage=0.0),
        prediction_error=PredictionError(steps_ahead=(1, 2), error_of_change=changed, by_entry={}),
        played=rows,
    )


@pytest.mark.parametrize(
    "rows, word",
    [
        ([row("logged", 0.4, 0.01)], "fit"),
        ([row("logged", 0.4, 0.3)], "weak"),  # it helps, and leaves much
        ([row("logged", 0.1, 0.2)], "unfit"),
        ([row("logged", 0.1, 0.2), row("logged", 0.4, 0.02, which=1)], "weak"),  # judges do not agree
        ([row("logged", 0.1, 0.2, auroc=0.7)], "fit"),  # who cannot tell danger is not heard
        ([row("logged", 0.01, 0.02)], "fit"),  # drivers who hardly meet danger are no test
        ([row("logged", 0.4, 0.01), row("bold", 0.9, 0.9)], "unfit"),
        ([row("bold", 0.9, 0.9, unknown=(0.9, 0.9))], "weak"),  # nobody knows
    ],
)
def test_a_guard_that_is_predicted_not_to_help_is_refused(rows, word):
    found = judge(card(*rows))
    assert found.word == word, found
    if word == "unfit":
        alone, guarded = rows[-1].alone, rows[-1].guarded
        assert f"{100 * guarded:.0f} %" in found.reasons[0] and f"{100 * alone:.0f} %" in found.reasons[0]


@pytest.mark.parametrize("changed, word", [((0.74, 0.8), "fit"), ((0.75, 0.8), "weak"), ((0.8, 1.2), "unfit")])
def test_predictions_that_err_from_the_first_step_on_are_weak(changed, word):
    assert judge(card(changed=changed)).word == word


def test_the_card_says_what_was_played():
    said = summary(replace(card(row("bold", 0.5, 0.1)), data=replace(Card().data, task="yard")))
    assert any("who heed nobody" in line and "50 %" in line and "10 %" in line for line in said)
    again = Card.from_json(card(row("bold", 0.5, 0.1)).to_json())
    assert again.played == (row("bold", 0.5, 0.1),)


def test_chances_grow_with_scores():
    score = np.linspace(0, 1, 200)
    chance = played._calibrated(score, np.random.default_rng(0).random(200) < score)
    assert np.all(np.diff(chance(score)) >= 0) and chance(np.array([0.95]))[0] > 0.7 > 0.3 > chance(np.array([0.05]))[0]
    assert chance(np.array([-9.0]))[0] == chance(np.array([0.0]))[0]


def test_who_wants_anything_goes_on_wanting_it():
    wants = played._wanted(np.random.default_rng(0), 50, 3, 2)
    assert wants.shape == (played.STEPS, 50, 3, 2) and set(np.unique(wants)) == {-1.0, 0.0, 1.0}
    same = (wants[1:] == wants[:-1]).all(-1).mean()
    assert played.STAYS - 0.02 < same < played.STAYS + 0.05


def test_who_does_as_the_logs_do(small_store, small_world):
    logged = _logged(small_store, small_world)
    x = logged.before(logged.fitted_steps[:500])
    acted = played._acts(
        played._driver(small_world, logged, np.random.default_rng(0)), played._standard(small_world, x)
    )
    given = logged.picked("actions", logged.fitted_steps[:500])
    assert acted.shape == given.shape and ((acted - given) ** 2).mean() < given.var()


def test_a_guard_is_played_inside_its_world(small_store, small_world, monkeypatch):
    monkeypatch.setattr(played, "STEPS", 24)  # more than a window is far from danger at first
    monkeypatch.setattr(played, "UPDATES", 5)
    logged = _logged(small_store, small_world)
    assert played.played(small_world, logged, Judging(played=0)) == ()
    rows = played.played(small_world, logged, Judging(played=4))
    assert [(r.driver, r.judge) for r in rows] == [("logged", 0), ("bold", 0), ("logged", 1), ("bold", 1)]
    shares = [share for r in rows for share in (r.alone, r.guarded, *r.unknown, r.auroc)]
    assert all(0 <= share <= 1 for share in shares)


def _logged(store, world) -> Logged:
    held = np.arange(store.episodes) % 4 == 0
    return Logged.of(store, world.map, held, {"": store.costs > 0})
