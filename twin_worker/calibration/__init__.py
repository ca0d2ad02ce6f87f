"""How far predictions may be trusted: misses, calibration tables, tubes and horizons that adapt to each aircraft."""
