"""A policy judged by logs alone, without a simulator."""

from ringfence.judging.judge import check, judge, words

__all__ = ["check", "judge", "words"]
