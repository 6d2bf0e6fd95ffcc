"""The arm of a rehearsal: it follows its targets exactly, and nothing is connected."""
