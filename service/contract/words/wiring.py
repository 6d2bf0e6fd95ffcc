"""Possible wiring mistakes of a cell on its first day, by the resulting signs of x and yaw."""

WIRINGS = {
    (-1, 1): "corrections in x reach the arm reversed, or the fingers are swapped",
    (1, -1): "corrections in yaw reach the arm reversed",
    (-1, -1): "both pictures are mirrored, or the arm's frame is turned by half a turn",
}
"""Signs of (estimate over known error) in x and yaw; a good cell has (1, 1)."""
