"""Assessment: recordings flown through the twins as if live, every start scored beside simpler methods."""
