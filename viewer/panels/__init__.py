"""Panels beside the scene."""
