"""The commands of `python -m service`: one module per command, each with a ``main(arguments) -> int``."""
