"""Models of autopilot control laws, one folder or file per autopilot."""
