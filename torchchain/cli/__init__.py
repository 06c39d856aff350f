"""The command line: flags in, a folder out."""

from torchchain.cli.entry import main

__all__ = ["main"]
