"""Reader of ArduPilot DataFlash logs, binary and text."""
