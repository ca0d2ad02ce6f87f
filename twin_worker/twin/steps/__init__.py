"""Steps of the twin's loop: identify, verify, predict, extrapolate, raise alerts."""
