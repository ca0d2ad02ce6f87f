"""The gateway's hot path: how fast it decodes, what a thousand aircraft cost it, and what random bytes do to it."""
