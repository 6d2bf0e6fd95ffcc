"""The commands of `python -m service`: one module a command, each with a ``main(arguments) -> int``."""
