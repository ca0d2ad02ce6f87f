"""Units of speeds and heights on the page: metric, or those of aviation."""

from math import isfinite
from typing import NamedTuple


class Units(NamedTuple):
    """Names of the units and how many of each are one of SI."""

    speed: str
    per_m_s: float
    height: str
    per_m: float

    def speed_text(self, m_s: float, digits: int = 1) -> str:
        """Format a speed [m/s]; a dash where there is none."""
        return f"{m_s * self.per_m_s:.{digits}f} {self.speed}" if isfinite(m_s) else "–"

    def height_text(self, metres: float) -> str:
        """Format a height [m]; a dash where there is none."""
        return f"{metres * self.per_m:,.0f} {self.height}" if isfinite(metres) else "–"


METRIC = Units("m/s", 1.0, "m", 1.0)
AVIATION = Units("kn", 3600 / 1852, "ft", 1 / 0.3048)
