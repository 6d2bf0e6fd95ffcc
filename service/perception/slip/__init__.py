"""Motion of the held object against the gel: contact, onset, slip."""
