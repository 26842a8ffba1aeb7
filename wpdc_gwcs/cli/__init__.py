"""The command line: `wpdc`."""

from wpdc_gwcs.cli.app import app, main

__all__ = ["app", "main"]
