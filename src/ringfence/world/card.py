"""What is known of a World, as a value and in words."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

JUDGED = 3  # steps ahead that the margin is calibrated for


def words(told: dict[str, Any]) -> list[str]:
    """The card as a person reads it."""
    if not told:
        return ["an empty card"]
    held, see, worth = told["held_out"], told["foresight"], told["values"]
    lines = [
        f"World of '{told['data']['task']}', seed {told['seed']}, sight {told['settings']['sight']}: "
        f"{told['data']['episodes']} episodes, judged on {held['episodes']} that nothing was fitted to "
        f"({held['steps']} steps)."
    ]
    errors = see["error_of_change"]
    far = ", ".join(
        f"{100 * errors[k]:.2g} % at {k + 1}" for k in sorted({0, min(2, len(errors) - 1), len(errors) - 1})
    )
    lines.append(f"Foresight errs by this share of what changes, steps ahead: {far}.")
    lines.append(
        f"Rewards of steps are explained to {100 * worth['reward_r2']:.3g} %, returns-to-go to "
        f"{100 * worth['value_r2']:.3g} % of their variance."
    )
    lines.append(
        f"It calls a place strange where its forward models are more than {told['strange']['threshold']:.2g} usual "
        f"steps apart: {100 * told['strange']['level']:g} % of held-out episodes never are."
    )
    danger = told.get("barrier")
    if danger is None:
        return [*lines, "No barrier: guards need a formula of danger."]
    if "warning" in danger:
        return [*lines, f"Barrier ({told['shape']}): {danger['warning']}."]
    lines.append(f"Barrier: {told['shape']}. {100 * danger['unsafe_share']:.3g} % of held-out steps are unsafe.")
    lines.append(
        f"With 1 false alarm in 100 safe steps it finds {100 * danger['recall']:.1f} % of the unsafe ones (AUROC "
        f"{danger['auroc']:.4f}); at 0 it calls {100 * danger['false_safe']:.2g} % of unsafe steps safe and "
        f"{100 * danger['false_unsafe']:.2g} % of safe ones unsafe."
    )
    for row in danger["calibration"]:
        lines.append(
            f"  of 1000 held-out steps with a margin of {row['margin']:g} or more, {row['unsafe_in_1000']:.2g} are "
            f"unsafe; {100 * row['safe_kept']:.3g} % of the safe steps have it"
        )
    told_of, kept = danger["avoidable"], danger.get("ahead_kept")  # which older cards lack
    shares = ", ".join(f"{100 * s:.3g} % at {k}" for k, s in zip(told_of["before"], told_of["avoided"]))
    lines.append(
        f"Could still be avoided, steps before entering danger: {shares}. Nearly all that can be takes a look "
        f"{told_of['rows']} ahead (rows={told_of['rows']}), where foresight reaches that far"
        + (f", or V, which leaves {100 * kept:.3g} % of the safe steps their margin." if kept is not None else ".")
    )
    for name, found in told.get("constraints", {}).items():
        limit = f"Constraint '{name}', at most {told['data']['constraints'][name]:g} per episode"
        lines.append(
            f"{limit}: {found['warning']}."
            if "warning" in found
            else f"{limit}: {100 * found['unsafe_share']:.3g} % of held-out steps are unsafe, of which it finds "
            f"{100 * found['recall']:.1f} % with 1 false alarm in 100 (AUROC {found['auroc']:.4f}); its margin is "
            f"{found['margin']:.2g}, the unit of the lines above."
        )
    if "constraints" in told:
        return lines
    lines.append(
        f"Default margin {danger['margin']:.2g}: of 1000 steps that entered danger, foreseen from up to {JUDGED} steps "
        f"before, {1000 * danger['missed']:.2g} looked as safe as that."
    )
    return lines


@dataclass(frozen=True, eq=False)
class Card:
    """What is known of a World: of which data, with which settings and seed, and how good on held-out episodes.
    `card["barrier"]["recall"]` and the like; `print(card)` says it in words (`card.py`)."""

    told: dict[str, Any]

    def __getitem__(self, name: str) -> Any:
        return self.told[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.told)

    def __str__(self) -> str:
        return "\n".join(words(self.told))
