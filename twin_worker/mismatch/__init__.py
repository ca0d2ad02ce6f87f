"""Live diagnosis: run in a process of its own, its result used in prediction."""
