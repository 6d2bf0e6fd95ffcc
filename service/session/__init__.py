"""One insertion at a time: its state machine, its clients, and the threads that feed it."""
