"""Robot controllers at work: on a bus in real time, or in a simulated world as fast as the processor allows."""
