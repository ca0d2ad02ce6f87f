"""Commands to aircraft, sent only for a proposal that a person has approved."""
