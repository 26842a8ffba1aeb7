"""The command line: `wpdc`."""

# The commands register themselves with the application.
from wpdc_gwcs.cli import calibrate, demo, evaluate, export, files, report, simulate, stages  # noqa: F401
from wpdc_gwcs.cli.app import app, main

__all__ = ["app", "main"]
