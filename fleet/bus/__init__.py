"""The Zenoh bus: sessions, encoding, liveliness, fencing by epoch, and an in-memory bus for tests."""
