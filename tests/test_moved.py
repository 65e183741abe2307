"""Paths of 0.1.0 lead to where things are now."""

import importlib
import sys

import pytest

from ringfence.utils.moved import MOVED


@pytest.mark.parametrize("name", MOVED)
def test_an_old_path_imports_and_says_the_new_one(name):
    full = f"ringfence.{name}"
    sys.modules.pop(full, None)
    with pytest.warns(FutureWarning, match=f"{full} is ringfence"):
        module = importlib.import_module(full)
    new = importlib.import_module(f"ringfence.{MOVED[name][0]}")
    public = [x for x in vars(new) if not x.startswith("_")]
    assert all(getattr(module, x) is getattr(new, x) for x in public)
    with pytest.raises(AttributeError, match="has no attribute 'nothing_of_this_name'"):
        _ = module.nothing_of_this_name


@pytest.mark.filterwarnings("ignore::FutureWarning")
def test_code_of_before_runs():
    from ringfence.data.make import make
    from ringfence.hazards import Separation

    from ringfence import evaluate, tasks

    assert tasks.get("crossing-hasty").hazard == Separation(0.30)
    assert callable(evaluate.load) and callable(evaluate.evaluate_policy) and callable(make)


def test_what_never_was_is_refused():
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("ringfence.nothing")
