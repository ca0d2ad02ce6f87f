"""Do proposals come in time, and does the simulator's aircraft avoid the event when it flies them?"""
