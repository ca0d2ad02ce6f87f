"""Publication of samples on the bus, and the history stored for late subscribers."""
