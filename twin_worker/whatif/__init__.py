"""What-if queries: a prediction under another route, speed, start, wind or parameters."""
