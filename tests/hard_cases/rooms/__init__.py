"""What is hard in each room, and what answers it."""
