"""What a finished network gains from pressing further, and the upper bound of any."""
