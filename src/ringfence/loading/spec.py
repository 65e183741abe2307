"""Who plays: a run and every choice of how it is played, as one value with a name that can be read back."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ringfence.datasets.registry import TASKS
from ringfence.errors import UserError, unknown, whole_number
from ringfence.guards import BARRIERS, GUARDS, GuardOptions, options_of
from ringfence.loading.oracle import ORACLE
from ringfence.proposals.options import DEFAULT, PLANNERS, PlanOptions
from ringfence.training.runs import Run
from ringfence.utils.config import fields_of, read_text
from ringfence.utils.files import place
from ringfence.world import World

EXECUTIONS = ("centralized", "decentralized")
SOURCES = (*BARRIERS, ORACLE)  # of what a guard knows danger by
Options = tuple[tuple[str, Any], ...]


@dataclass(frozen=True)
class PolicySpec:
    """A run, and how it is to be played. `of` makes one from names and options and refuses what cannot be; `name` says
    it in one word, e.g. `low_temperature+shield-learned+horizon7+agents4`, and `parse` reads that back. Neither the
    order in which options were given nor how their values were spelled makes another spec."""

    run: Run | None = None
    checkpoint: int | None = None  # the step of the one that is played; None: the last
    planner: str = DEFAULT  # a named set of PlanOptions
    plan_options: Options = ()  # given beside it, in the order of the fields
    guard: str = "none"  # a named set of GuardOptions
    guard_options: Options = ()
    barrier: str = "learned"  # what the guard knows danger by
    execution: str | None = None  # decentralized: every agent guards itself; None: as the task
    world: World | Path | None = field(default=None, compare=False)  # None: that of the run's data and seed
    agents: int | None = None  # who play, where agents are homogeneous; None: as many as in the logs
    anyway: bool = field(default=False, compare=False)  # guard by a World that is unfit to, too

    @classmethod
    def of(
        cls,
        run: Run | str | Path | None = None,
        *,
        checkpoint: int | None = None,
        planner: str = DEFAULT,
        guard: str = "none",
        barrier: str | None = None,
        execution: str | None = None,
        world: World | str | Path | None = None,
        agents: int | None = None,
        anyway: bool = False,
        **options: Any,
    ) -> PolicySpec:
        """Names and options, each sorted to whom it belongs: `options` are fields of PlanOptions and GuardOptions.
        Unknown names are refused, and so is what nothing would read. `execution` is the guard's, and without one the
        planner's."""
        _known("planner", planner, PLANNERS)
        _known("guard", guard, GUARDS)
        guards = guard != "none" or any(f.name in options for f in dataclasses.fields(GuardOptions))
        if execution is not None and not guards:
            options["execution"] = execution
            execution = None
        _known("execution", execution or "centralized", EXECUTIONS)
        if barrier is not None:
            _known("barrier", barrier, SOURCES)
        guard_names = [f.name for f in dataclasses.fields(GuardOptions)]
        plan_names = [f.name for f in dataclasses.fields(PlanOptions)]
        for name in options:
            if name not in guard_names + plan_names:
                raise unknown("option of planner or guard", name, {*guard_names, *plan_names})
        of_plans = {name: value for name, value in options.items() if name not in guard_names}
        of_guard = {name: value for name, value in options.items() if name in guard_names}
        if agents is not None:
            whole_number("agents", agents, 1, 100_000)
        spec = cls(
            run=None if run is None else Run.of(run),
            checkpoint=checkpoint,
            planner=planner,
            plan_options=_options(PlanOptions, of_plans),
            guard=guard,
            guard_options=_options(GuardOptions, of_guard),
            barrier=barrier or "learned",
            execution=execution,
            world=world if world is None or isinstance(world, World) else place(world),
            agents=agents,
            anyway=anyway,
        )
        if not spec.guarded:
            guides = options.get("value_guidance") or options.get("barrier_guidance")
            for name, given in (("barrier", barrier), ("world", None if guides else world)):
                if given is not None:
                    raise UserError(f"{name} is read by nothing without a guard; name one with guard=, e.g. shield.")
        return spec

    @classmethod
    def parse(cls, name: str, run: Run | str | Path | None = None) -> PolicySpec:
        """The spec of that `name`."""
        options: dict[str, Any] = {}
        for part in name.split("+"):
            options |= dict(_part(part, name))
        return cls.of(run, **options)

    @property
    def guarded(self) -> bool:
        return self.guard != "none" or bool(self.guard_options)

    @property
    def guard_decides(self) -> bool:
        """Whether its guard decides what plans earn: it climbs values itself, or spends what limits allow by a margin
        that adapts, where guidance keeps it always."""
        options = options_of(self.guard, self.barrier, **dict(self.guard_options))
        return any(options.get(name, 0) > 0 for name in ("optimizer_steps", "adapt"))

    @property
    def name(self) -> str:
        """Planner, guard with its barrier and execution, and the options given beside them; `default` without any."""
        parts = [] if self.planner == DEFAULT else [self.planner]
        if self.guarded:
            alone = "-decentralized" if self.execution == "decentralized" else ""
            parts.append(f"{self.guard}-{self.barrier}{alone}")
        parts += [f"{name}{value}" for name, value in self.plan_options + self.guard_options]
        if self.agents is not None:
            parts.append(f"agents{self.agents}")
        return "+".join(parts) or DEFAULT

    @property
    def words(self) -> list[str]:
        """The same as options of a command, without the run."""
        words: list[Any] = [] if self.checkpoint is None else ["--checkpoint", self.checkpoint]
        words += [] if self.planner == DEFAULT else ["--planner", self.planner]
        words += [] if self.agents is None else ["--agents", self.agents]
        words += ["--guard", self.guard, "--barrier", self.barrier] if self.guarded else []
        plan_options = dict(self.plan_options)
        execution = self.execution if self.guarded else plan_options.pop("execution", None)
        words += ["--execution", execution] if execution else []
        if isinstance(self.world, Path):
            words += ["--world", self.world]
        elif self.world is not None and self.world.card.data.task not in TASKS:  # whoever plays has to have it
            words += ["--world", "DATA.world"]
        words += ["--anyway"] if self.anyway else []
        settings = plan_options | dict(self.guard_options)
        words += ["--set", *(f"{name}={value}" for name, value in settings.items())] if settings else []
        return [str(word) for word in words]

    def variant(self, preset: str, split: str = "test") -> str:
        """The name of a result: whose preset it is, how it was played, and what is not as in every table."""
        name = preset if self.name == DEFAULT else f"{preset}+{self.name}"
        if split != "test":
            name += f"@{split}"
        return name if self.checkpoint is None else f"{name}@step{self.checkpoint}"

    def of_run(self, run: Run | str | Path) -> PolicySpec:
        """The same choices for another run."""
        return replace(self, run=Run.of(run))

    def with_guard_options(self, **changes: Any) -> PolicySpec:
        """The same choices with some of the guard's options changed."""
        return replace(self, guard_options=_options(GuardOptions, {**dict(self.guard_options), **changes}))

    def without_plans(self) -> PolicySpec:
        """The same of a policy that draws no plans, which reads no choice of planners."""
        return replace(self, planner=DEFAULT, plan_options=())


def _known(kind: str, name: Any, known: Any) -> None:
    if not isinstance(name, str) or name not in known:
        raise unknown(kind, name, known)


def _options(kind: type, given: Mapping[str, Any]) -> Options:
    """Options in the order of the fields, each of its field's type; those that cannot be are left for `build_config`
    to refuse."""
    fields = [f for f in dataclasses.fields(kind) if f.name in given]
    return tuple((f.name, _typed(kind, f.name, given[f.name], f.default)) for f in fields)


def _typed(kind: type, name: str, value: Any, default: Any) -> Any:
    if isinstance(value, str):
        return read_text(fields_of(kind)[name], value)
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, bool) or not isinstance(value, int | float):
        return value
    if isinstance(default, float):
        return float(value)
    whole = isinstance(value, float) and value.is_integer()
    return int(value) if whole and not isinstance(default, bool) else value


_GUARD = re.compile(rf"({'|'.join(GUARDS)})-({'|'.join(SOURCES)})(-decentralized)?")
_AGENTS = re.compile(r"agents(\d+)")


def _part(part: str, name: str) -> Iterator[tuple[str, Any]]:
    """What one part of a name says, as arguments of `PolicySpec.of`."""
    if part in PLANNERS:
        yield "planner", part
    elif found := _GUARD.fullmatch(part):
        yield "guard", found[1]
        yield "barrier", found[2]
        if found[3]:
            yield "execution", "decentralized"
    elif found := _AGENTS.fullmatch(part):
        yield "agents", int(found[1])
    else:
        fields = [f.name for kind in (PlanOptions, GuardOptions) for f in dataclasses.fields(kind)]
        option = max((f for f in fields if part.startswith(f) and part != f), key=len, default=None)
        if option is None:
            raise UserError(f"'{part}' in '{name}' says nothing of planner or guard; name a guard as shield-learned.")
        yield option, part[len(option) :]
