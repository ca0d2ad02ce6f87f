"""The Zenoh bus: sessions, encoding, liveliness, fencing by epoch."""
