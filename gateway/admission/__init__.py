"""Which frames are accepted: message filter, signature check, limits."""
