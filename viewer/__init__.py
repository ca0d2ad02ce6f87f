"""Judgement to picture: the operator's page."""
