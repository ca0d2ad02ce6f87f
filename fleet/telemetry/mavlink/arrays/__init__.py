"""State of many aircraft in arrays: the number of calls per pass is independent of the number of aircraft."""
