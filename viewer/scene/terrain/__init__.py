"""Ground elevation and imagery from local files."""
