"""What pressing further tells a finished network, and the limit of any."""
