"""Messages as received from the bus, their times and rows."""
