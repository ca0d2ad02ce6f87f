"""Colours of the page and the inverse of the renderer's tone mapping."""

from dataclasses import dataclass

import numpy as np

from fleet.contract import TwinState
from viewer.theme.events import EventKind

STATE_STYLE = {  # glyph and `Palette` field of each state, the most severe first
    TwinState.LINK_LOST: ("✕", "lost"),
    TwinState.UNCLAIMED: ("○", "muted"),
    TwinState.WAITING: ("◌", "muted"),
    TwinState.IDENTIFYING: ("◐", "identifying"),
    TwinState.PLAUSIBLE: ("≈", "plausible"),
    TwinState.PREDICTING: ("➤", "predicting"),
    TwinState.VERIFIED: ("✓", "verified"),
}
STATE_TEXT = {state: state.value.replace("_", " ") for state in TwinState}
STATUS_COLOURS = (
    "muted",
    "predicting",
    "verified",
    "plausible",
    "identifying",
    "lost",
    "mismatch",
)  # of the display statuses


@dataclass(frozen=True)
class Palette:
    """Colours of one theme, as sRGB hex; the defaults are the dark theme."""

    dark: bool = True
    predicting: str = "#3E96DC"
    verified: str = "#2BC49A"
    plausible: str = "#B7BE5A"
    identifying: str = "#F0B8E0"
    lost: str = "#7F8894"
    mismatch: str = "#FF6B35"
    horizon: str = "#F0E442"
    ground: str = "#0E141E"
    ink: str = "#E6EDF5"
    muted: str = "#8B98A8"
    section: str = "#2A3849"
    ring: str = "#3B4D63"
    tube: str = "#56B4E9"
    route: str = "#9A8FD0"
    coast: str = "#5F93A8"
    border: str = "#8A7F96"
    actual: str = "#DCE6F0"
    sky: tuple[str, str] = ("#0B0F17", "#1A2433")

    def status_colours(self) -> np.ndarray:
        """Return the colours of the display statuses, (7, 3) [0..255]."""
        return np.array([rgb(getattr(self, name)) for name in STATUS_COLOURS])

    def option(self, number: int) -> str:
        """Return the colour of an option of a proposal by its number from 1 on; the fourth has that of the first."""
        return (self.verified, self.identifying, self.plausible)[(number - 1) % 3]

    def event(self, kind: EventKind) -> str:
        """Return the colour of an event kind."""
        return getattr(self, kind.colour)


DARK = Palette()
LIGHT = Palette(
    dark=False,
    predicting="#0072B2",
    verified="#00795A",
    plausible="#676B00",
    identifying="#6A2C7A",
    lost="#6B7280",
    mismatch="#B93A00",
    horizon="#A67C00",
    ground="#F4F6F9",
    ink="#17212E",
    muted="#566579",
    section="#CBD5E0",
    ring="#94A3B8",
    tube="#0072B2",
    route="#7A6BB8",
    coast="#3F7A94",
    border="#857A93",
    actual="#334155",
    sky=("#DCE6F0", "#FFFFFF"),
)

# ACES filmic fit as the renderer applies it to every line. Source: Hill, "BakingLab" 2016, ACES.hlsl.
_IN = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
_OUT = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])
_EXPOSURE = 0.6


def rgb(colour: str) -> np.ndarray:
    """Parse `#RRGGBB` as (3,) floats [0..255]."""
    return np.array(triple(colour), float)


def triple(colour: str) -> tuple[int, int, int]:
    """Parse `#RRGGBB` as three integers, as viser expects them."""
    r, g, b = bytes.fromhex(colour[1:])
    return r, g, b


def mix(colour: str, other: str, share: float) -> np.ndarray:
    """Blend two colours, `share` of the first: (3,) [0..255]; lines have no alpha."""
    return rgb(colour) * share + rgb(other) * (1 - share)


def line_colour(displayed: np.ndarray) -> np.ndarray:
    """Return the vertex colour that the renderer shows as `displayed`: (..., 3) sRGB [0..255] -> (..., 3) uint8.

    The renderer treats vertex colours as linear and tone-maps them; this inverts both, clipped to its range.
    """
    y = np.clip(_linear(np.asarray(displayed, float) / 255) @ np.linalg.inv(_OUT).T, 0, 0.98)
    a, b, c = 1 - 0.983729 * y, 0.0245786 - 0.432951 * y, -(0.000090537 + 0.238081 * y)
    v = (-b + np.sqrt(b * b - 4 * a * c)) / (2 * a)
    return np.rint(255 * np.clip(_EXPOSURE * v @ np.linalg.inv(_IN).T, 0, 1)).astype(np.uint8)


def mesh_colour(displayed: np.ndarray) -> np.ndarray:
    """Return linear instance colours of a lit mesh: (n, 3) sRGB [0..255] -> uint8."""
    return np.rint(255 * _linear(np.clip(np.asarray(displayed, float), 0, 255) / 255)).astype(np.uint8)


def _linear(s: np.ndarray) -> np.ndarray:
    return np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
