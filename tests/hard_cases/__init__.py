"""Hard cases of every room: what is nasty, what must hold, how close it came. `python -m tests.hard_cases --help`."""
