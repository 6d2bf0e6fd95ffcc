"""Text from elsewhere, made harmless for a terminal."""


def printable(line: str) -> str:
    r"""The same line with everything that a terminal would obey written out: ``\x1b``, ``\n``, ``\u202e``."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "replace").decode() for c in line)
