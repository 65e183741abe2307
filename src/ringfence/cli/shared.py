"""What commands share: flags of how a run is played, how logs are replayed and what goes wrong in a closed loop; and
what is said to a person."""

from __future__ import annotations

import dataclasses
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.markup import escape

from ringfence.errors import UserError, plain
from ringfence.faults import Chance, Faults
from ringfence.utils.files import writable

if TYPE_CHECKING:
    from ringfence.training.runs import Run

WIDE = 1000  # columns of what is no terminal: nothing is cut that another program, or a file, is to read
# --set a=1 b=2 and --set a=1 --set b=2 mean the same.
Assignments = Annotated[list[list[str]], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME=VALUE")]


@dataclass(frozen=True)
class Playing:
    """Choices of evaluation time."""

    guard: Literal["none", "select", "shield", "adapt", "refine", "full"] = "none"
    """what is done with what the policy proposes: select among several plans, refine them up the value, shield
    (correct them until danger keeps its distance), adapt the shield's margin to what happens; full does all."""
    barrier: Literal["learned", "analytic", "both"] | None = None
    """how the guard knows danger: learned from the logs (default), by the task's formula, or the worse of both."""
    execution: Literal["centralized", "decentralized"] | None = None
    """centralized: one guard sees the team; decentralized: every agent guards its own action by its own view. Without
    a guard: how a planner plans."""
    agents: int | None = None
    """who play, where they are homogeneous (Crossing); as many as in the logs by default."""
    world: Path | None = None
    """a file of `ringfence fit --out`, needed for data of your own; else that of the run's data and seed."""
    anyway: bool = False
    """guard by a World whose verdict is unfit, too."""
    planner: Literal["default", "low_temperature", "published"] = "default"
    """how diffusion planners draw plans: low_temperature is for robots, published is MADIFF's (preset raw-return)."""
    num_samples: int | None = None
    """proposals that the guard asks for."""
    margin: float | None = None
    """kept from danger, in units of its source: calibrated margins, or the hazard's safe margin."""
    horizon: int | None = None
    """rows that the guard predicts and judges."""
    sampling_steps: int | None = None
    """of the sampler."""
    sampler: str | None = None
    """ddim, ddpm or dpm++."""
    cfg_scale: float | None = None
    """ω of classifier-free guidance."""
    target_return: float | None = None
    """return condition, as a normal score."""
    temperature: float | None = None
    """scale of the first noise."""
    replan: int | None = None
    """steps for which a plan is followed."""
    set: Assignments = field(default_factory=list)
    """any other option of planner or guard, e.g. --set correction_steps=20 value_guidance=0; docs/options.md lists
    them."""

    def arguments(self) -> dict[str, Any]:
        """What was given, as arguments of `PolicySpec.of`; refused before any run is played."""
        from ringfence.loading.spec import PolicySpec

        given = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "set"}
        given = {name: value for name, value in given.items() if value is not None and value is not False}
        assigned = assignments(self.set)
        flags = {"episodes", "split", "num_recorded", "checkpoint", *_FLAGS_ALONE}
        for name, value in assigned.items():
            if name in flags:
                flag = f"--{name.replace('_', '-')}"
                raise UserError(f"--set {name}={value} is no option of planner or guard; write {flag} {value}.")
            if name in given:
                raise UserError(f"--{name} {given[name]} and --set {name}={value} both set {name}; give one of them.")
        checked: dict[str, Any] = dict(assigned)
        PolicySpec.of(**checked)  # an unknown name, or a value of another type
        return given | assigned


_FLAGS_ALONE = ("planner", "guard", "barrier", "execution", "world", "agents", "anyway")
AS_IT_IS = Playing()
How = tyro.conf.OmitArgPrefixes[Playing]


def assignments(given: list[list[str]]) -> dict[str, str]:
    """Names and values of every --set; each of them takes several."""
    changes: dict[str, str] = {}
    for pair in (pair for pairs in given for pair in pairs):
        name, equals, value = pair.partition("=")
        if not equals or not name:
            raise UserError(f"--set {pair} is not of the form name=value; write e.g. --set margin=0.5.")
        if name in changes:
            raise UserError(f"--set gives {name} twice, {changes[name]} and {value}; give one of them.")
        changes[name] = value
    return changes


@dataclass(frozen=True)
class Replaying:
    """Windows of logs in which one agent is driven; docs/replay.md says how."""

    kinematics: Literal["double_integrator", "holonomic", "unicycle", "bicycle", "world"] | None = None
    """how the driven agent moves; by default a double integrator where that explains the logs, else the World's."""
    wheelbase: float = 2.7
    """m, of a bicycle."""
    radius: float | None = None
    """m between two agents below which they touch; by default the task's formula, else as costs tell it, else the
    World's causes."""
    steps: int | None = None
    """of a window; 8 s by default."""
    every_episode: bool = False
    """replay the episodes that the World learned from, too."""

    def arguments(self) -> dict[str, Any]:
        """The same as arguments of `replay` and `certify`."""
        return dataclasses.asdict(self)


AS_LOGGED = Replaying()
Replayed = Annotated[tyro.conf.OmitArgPrefixes[Replaying], tyro.conf.arg(name="replays")]


@dataclass(frozen=True)
class FaultFlags(Faults):
    """What goes wrong; docs/certificates.md says what each does."""

    asynchrony: Annotated[Chance, tyro.conf.arg(name="async")] = 0.0
    """share of steps that an agent lets pass, each in its own rhythm."""

    def __post_init__(self):
        """Refuse nothing yet: a refusal in the parser would be no sentence."""

    def faults(self) -> Faults:
        """The same as a value; refused before any run is played."""
        return Faults.of(dataclasses.asdict(self))


NO_FAULTS = FaultFlags()
Wrong = Annotated[tyro.conf.OmitArgPrefixes[FaultFlags], tyro.conf.arg(name="faults")]


def page_at(report: Path | None) -> Path | None:
    """Where a page is to be written: refused before any work where none can be, or where nothing here draws one."""
    if report is None:
        return None
    from ringfence import report as pages

    pages.build_report  # noqa: B018 (loads what draws)
    return writable(report)


def console() -> Console:
    """Of stdout, as wide as its terminal."""
    terminal = sys.stdout is not None and sys.stdout.isatty()  # None: it was closed
    return Console(highlight=False, width=None if terminal else WIDE)


def complain(message: str) -> None:
    """Say on stderr what is wrong."""
    Console(stderr=True, highlight=False).print(f"[red]error:[/] {escape(message)}", soft_wrap=True)


def plain_warnings() -> None:
    """Have warnings say what they say, and not where in the code."""
    warnings.formatwarning = lambda message, *_, **__: f"warning: {plain(str(message))}\n"


@dataclass
class Refusals:
    """Why runs were refused, so that what several are refused for is said once."""

    runs: dict[str, list[Run]] = field(default_factory=dict)  # by message

    @contextmanager
    def of(self, run: Run) -> Iterator[None]:
        """Note down a refusal of this run and go on."""
        try:
            yield
        except UserError as error:
            self.runs.setdefault(str(error), []).append(run)
