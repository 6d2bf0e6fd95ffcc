"""What the operator's page shows: its state and alarms, its pictures, and insertions of the past."""
