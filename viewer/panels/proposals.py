"""Proposals of the selected UAV: each option with its figures, and how to approve it."""

from html import escape
from math import isfinite

from fleet.contract import Option
from fleet.report.changes import ID_LETTERS
from viewer.panels.approval import APPROVE, button
from viewer.store.proposal import MAX_OPTIONS, SceneProposal
from viewer.store.vehicle import Vehicle
from viewer.text.units import METRIC, Units
from viewer.theme.events import clip
from viewer.theme.palette import Palette

MAX_TEXT = 300  # characters of a received text
MAX_CLEARANCE_M = 1e5  # a larger clearance means that nothing is near [m]


def proposals_html(vehicle: Vehicle, palette: Palette, now: float, units: Units = METRIC, approve: str = "") -> str:
    """Return the proposals against the active alerts of a UAV as HTML; received texts are escaped here.

    Args:
        vehicle: the selected UAV
        palette: colours of the page
        now: monotonic [s]
        units: of the page
        approve: page code that sends the text of a button at `{}`; empty: the command is shown instead
    """
    clock, cards, number = vehicle.data_time(now), [], 0
    for proposal in vehicle.open_proposals():
        message, rows = proposal.message, []
        for index, option in enumerate(proposal.options if proposal.is_valid(clock) else ()):
            number += 1
            if number <= MAX_OPTIONS:
                how = _approval(proposal, index, approve)
                rows.append(_option(option, number, message.probability, (palette, units), how))
        if rows or not message.options:
            text = escape(clip(message.sentence, MAX_TEXT))
            colour = palette.mismatch if not rows else palette.horizon
            cards.append(f'<div class="say" style="border-color:{colour}">{text}{"".join(rows)}</div>')
    return "".join(cards)


def _option(option: Option, number: int, before: float | None, style: tuple[Palette, Units], how: str) -> str:
    palette, units = style
    figures = [units.height_text(option.clearance_m) + " clearance"] if _is_near(option.clearance_m) else []
    figures += [f"{option.delay_s:+.0f} s", f"energy {100 * (option.energy - 1):+.0f} %"]
    figures.append(f"deviation {units.height_text(option.deviation_m)}")
    risk = f"{100 * option.probability:.0f} %"
    figures.append(f"risk {risk}" if before is None else f"risk {100 * before:.0f} % → {risk}")
    return (
        f'<div class="option"><b style="color:{palette.option(number)}">{number}</b> '
        f'{escape(clip(option.sentence, MAX_TEXT))}<div class="soft">{" · ".join(figures)}</div>{how}</div>'
    )


def _is_near(clearance_m: float) -> bool:
    return isfinite(clearance_m) and clearance_m < MAX_CLEARANCE_M


def _approval(proposal: SceneProposal, index: int, code: str) -> str:
    """Return the button that asks to approve an option, or the command that does so."""
    message = proposal.message
    name = "".join(letter for letter in message.id[:40] if letter.isalnum())
    if code:
        return button(code, f"{APPROVE}/{message.uav}/{name}/{index}", "Approve …")
    return f'<div class="command">fleet approve {name[:ID_LETTERS]} --option {index + 1}</div>'
