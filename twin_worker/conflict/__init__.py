"""Alerts from predictions: pure judgement in data time; nothing here knows a bus."""
