"""State of many aircraft at once, as arrays: a tick costs the same few calls for one or for a thousand."""
