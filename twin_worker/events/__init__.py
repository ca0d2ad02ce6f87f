"""What ends a running prediction, or what it coasts through: each an `Event` of the contract, told once, with its time.

note.py takes an event down; heard.py finds those that messages tell; watch.py those that only the flight shows.
"""
