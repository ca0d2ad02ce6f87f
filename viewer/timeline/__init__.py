"""Timeline of the page: recording, replay, and past predictions compared with the flight."""
