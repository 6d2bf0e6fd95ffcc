"""Hard cases of every package: the difficulty, the requirement, and the margin. `python -m tests.hard_cases --help`."""
