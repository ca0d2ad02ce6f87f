"""Autopilot twins, one folder or file each: `ls` is the catalogue."""
