"""State of many aircraft in arrays: one pass costs the same few calls for one aircraft or a thousand."""
