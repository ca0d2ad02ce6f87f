"""State of every aircraft as received from the bus."""
