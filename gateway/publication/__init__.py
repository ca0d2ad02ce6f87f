"""Publication of samples on the bus, and the history kept for late subscribers."""
