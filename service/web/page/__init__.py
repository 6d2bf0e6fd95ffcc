"""Contents of the operator's page: its state and alarms, its pictures, and past insertions."""
