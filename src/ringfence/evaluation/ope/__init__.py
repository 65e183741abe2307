"""Off-policy evaluation: a policy by logs alone, without a simulator."""

from ringfence.evaluation.ope.estimate import check, check_sizes, ope
from ringfence.evaluation.ope.result import OPEResult

__all__ = ["OPEResult", "check", "check_sizes", "ope"]
