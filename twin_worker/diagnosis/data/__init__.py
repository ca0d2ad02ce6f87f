"""Input data: recorded flight, aircraft card, fault hypotheses."""
