"""ABB arms over EGM position guidance; RWS starts and stops the program."""
