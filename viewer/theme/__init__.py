"""Colours, shapes and number formats of the page."""
