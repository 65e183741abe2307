"""Who plays, as one value: names that read back, options sorted to whom they belong, refusals."""

import pytest

from ringfence.bench.suites import SUITES
from ringfence.errors import UserError
from ringfence.loading.spec import PolicySpec

NAMES = sorted({name for suite in SUITES.values() for e in suite.entries for name in e.evaluations})


@pytest.mark.parametrize("name", NAMES)
def test_every_name_of_a_suite_reads_back(name):
    assert PolicySpec.parse(name).name == name


def test_a_name_does_not_follow_the_order_or_the_spelling_of_options():
    wanted = "steady+shield-formula-own+temperature0.5+reach2.0+rows7+agents4"
    first = PolicySpec.of(
        planner="steady", guard="shield", danger="formula", sight="own", agents=4, rows="7", reach=2, temperature=0.5
    )
    other = PolicySpec.of(
        temperature="0.5",
        agents=4,
        reach=2.0,
        rows=7.0,
        sight="own",
        danger="formula",
        guard="shield",
        planner="steady",
    )
    assert first == other == PolicySpec.parse(wanted) and first.name == wanted
    assert hash(first) == hash(other)


def test_what_a_result_is_called():
    assert PolicySpec.of().variant("split") == "split"
    guarded = PolicySpec.of(guard="shield", checkpoint=40)
    assert guarded.variant("split", "validation") == "split+shield-learned@validation@step40"
    assert PolicySpec.of(planner="steady", steps=3).without_plans().name == "plain"


@pytest.mark.parametrize(
    "options, message",
    [
        ({"guard": "shild"}, "did you mean 'shield'"),
        ({"planner": "stedy"}, "did you mean 'steady'"),
        ({"rws": 3}, "Unknown option of planner or guard 'rws'"),
        ({"danger": "formula"}, "danger is read by nothing without a guard"),
        ({"sight": "own"}, "sight is read by nothing without a guard"),
        ({"agents": 0}, "agents=0 must be a whole number"),
        ({"rows": "seven"}, "rows"),
    ],
)
def test_bad_choices_are_refused(options, message):
    with pytest.raises(UserError, match=message):
        PolicySpec.of(**options)


@pytest.mark.parametrize("name", ["learned-shield", "plain+", "agentsx", "rows"])
def test_a_name_that_says_nothing_is_refused(name):
    with pytest.raises(UserError, match="says nothing of planner or guard"):
        PolicySpec.parse(name)
