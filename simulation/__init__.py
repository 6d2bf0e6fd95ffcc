"""The cell that is not there: physics of the held object, imprints of the gel, the real protocols on loopback."""
