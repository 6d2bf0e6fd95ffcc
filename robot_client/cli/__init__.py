"""The commands of the robot client."""
