"""Who plays, as one value: names that read back, options sorted to whom they belong, refusals."""

import dataclasses

import msgspec
import pytest
import tyro

from ringfence.bench.suites import SUITES
from ringfence.cli.shared import Playing
from ringfence.errors import UserError
from ringfence.loading.spec import PolicySpec

NAMES = sorted({name for suite in SUITES.values() for e in suite.entries for name in e.evaluations})


@pytest.mark.parametrize("name", NAMES)
def test_every_name_of_a_suite_reads_back(name):
    assert PolicySpec.parse(name).name == name


@pytest.mark.parametrize("name", [*NAMES, "executiondecentralized", "low_temperature+temperature0.5"])
def test_the_words_of_a_spec_are_options_of_the_command_line(name):
    """What a result says made it is what the command line reads."""
    spec = PolicySpec.parse(name)
    if spec.barrier == "oracle":  # of benchmarks alone
        return
    read = tyro.cli(Playing, args=spec.words)
    assert PolicySpec.of(**read.arguments()) == spec


def test_a_world_that_was_given_is_among_the_words(small_world):
    """Its file, or where it came as a value a place for one: of a task's data whoever plays can fit it."""
    assert PolicySpec.of(guard="shield", world="a b.world").words[-2:] == ["--world", "a b.world"]
    assert "--world" not in PolicySpec.of(guard="shield", world=small_world).words
    data = msgspec.structs.replace(small_world.card.data, task="harbour")
    own = dataclasses.replace(small_world, card=msgspec.structs.replace(small_world.card, data=data))
    assert PolicySpec.of(guard="shield", world=own).words[-2:] == ["--world", "DATA.world"]


def test_a_name_does_not_follow_the_order_or_the_spelling_of_options():
    wanted = "low_temperature+shield-analytic-decentralized+temperature0.5+trust_radius2.0+horizon7+agents4"
    first = PolicySpec.of(
        planner="low_temperature",
        guard="shield",
        barrier="analytic",
        execution="decentralized",
        agents=4,
        horizon="7",
        trust_radius=2,
        temperature=0.5,
    )
    other = PolicySpec.of(
        temperature="0.5",
        agents=4,
        trust_radius=2.0,
        horizon=7.0,
        execution="decentralized",
        barrier="analytic",
        guard="shield",
        planner="low_temperature",
    )
    assert first == other == PolicySpec.parse(wanted) and first.name == wanted
    assert hash(first) == hash(other)


def test_names_of_results_are_understood():
    spec = PolicySpec.of(
        planner="low_temperature", guard="shield", barrier="analytic", execution="decentralized", horizon=7,
        trust_radius=2.0, target_return=1.0,
    )  # fmt: skip
    assert spec == PolicySpec.parse(
        "low_temperature+shield-analytic-decentralized+target_return1.0+trust_radius2.0+horizon7"
    )
    assert PolicySpec.of(execution="decentralized").plan_options == (("execution", "decentralized"),)


def test_what_a_result_is_called():
    assert PolicySpec.of().variant("split") == "split"
    guarded = PolicySpec.of(guard="shield", checkpoint=40)
    assert guarded.variant("split", "validation") == "split+shield-learned@validation@step40"
    assert PolicySpec.of(planner="low_temperature", sampling_steps=3).without_plans().name == "default"


@pytest.mark.parametrize(
    "options, message",
    [
        ({"guard": "shild"}, "did you mean 'shield'"),
        ({"planner": "low_temprature"}, "did you mean 'low_temperature'"),
        ({"rws": 3}, "Unknown option of planner or guard 'rws'"),
        ({"barrier": "analytic"}, "barrier is read by nothing without a guard"),
        ({"agents": 0}, "agents=0 must be a whole number"),
        ({"horizon": "seven"}, "horizon"),
    ],
)
def test_bad_choices_are_refused(options, message):
    with pytest.raises(UserError, match=message):
        PolicySpec.of(**options)


@pytest.mark.parametrize("name", ["learned-shield", "default+", "agentsx", "horizon"])
def test_a_name_that_says_nothing_is_refused(name):
    with pytest.raises(UserError, match="says nothing of planner or guard"):
        PolicySpec.parse(name)
