"""A policy judged by logs alone, without a simulator."""

from ringfence.evaluation.ope.estimate import check, judge, words

__all__ = ["check", "judge", "words"]
