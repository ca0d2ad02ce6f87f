"""What a recording contains: rows, rates, gaps, and what can be done with it."""
