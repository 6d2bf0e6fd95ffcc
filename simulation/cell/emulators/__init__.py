"""Devices of the cell as sockets on loopback: they speak the real protocols, with the physics behind them."""
